"""Files of records: CSV with its provenance in a comment, and JSON."""

import csv
import io
import json
from collections.abc import Mapping, Sequence

Scalar = str | float | None
"""Value of a record: text, number, truth or nothing."""


def csv_text(
    records: Sequence[Mapping[str, Scalar]], names: Sequence[str] = (), made_by: Mapping[str, object] | None = None
) -> str:
    """CSV with a line per record; floats in full, nothing is empty.

    Args:
        records: rows by the names of the columns.
        names: columns in their order; default: all of the records.
        made_by: provenance, as JSON in a comment (#) on the first line; None for no such line.
    """
    text = io.StringIO()
    if made_by is not None:
        text.write(f"# {json.dumps(made_by, sort_keys=True, allow_nan=False)}\n")
    columns = names or list(dict.fromkeys(name for record in records for name in record))
    writer = csv.DictWriter(text, columns, restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows(records)
    return text.getvalue()


def json_text(content: Mapping[str, object]) -> str:
    """JSON of a result, the same for the same content."""
    return json.dumps(content, indent=1, sort_keys=True, allow_nan=False) + "\n"
