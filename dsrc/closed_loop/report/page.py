"""Page of a campaign: one HTML file without any other, its tables, plots, and the episodes that failed as pictures."""

import base64
import html
from collections.abc import Iterable, Sequence
from pathlib import Path

from dsrc.closed_loop.campaign.episode import EpisodeResult
from dsrc.closed_loop.campaign.run import CampaignResult
from dsrc.closed_loop.log import EpisodeLog
from dsrc.closed_loop.metrics.comparison import metric
from dsrc.closed_loop.report.baseline import episode_name
from dsrc.closed_loop.report.findings import Findings
from dsrc.closed_loop.types import FAILED, Outcome
from dsrc.runs.executors import Progress
from dsrc.tables.table import Table

_MOST = 24
"""Most pictures of a page: the episodes that broke against the baseline first, then the hardest crashes."""
_FAILED = tuple(one.value for one in (Outcome.CRASHED, Outcome.LEFT, Outcome.STUCK, *FAILED))
_STYLE = """
body{font:15px/1.45 system-ui,sans-serif;color:#22272e;max-width:1100px;margin:2em auto;padding:0 1em}
table{border-collapse:collapse;margin:.6em 0;display:block;overflow-x:auto}
td,th{padding:.2em .7em;border-bottom:1px solid #e3e6ea;text-align:left}
td.n,th.n{text-align:right;font-variant-numeric:tabular-nums}p.note{color:#57606a;max-width:70em}img{max-width:100%}
.failures{display:grid;grid-template-columns:repeat(auto-fill,minmax(320px,1fr));gap:1em}
figure{margin:0;border:1px solid #e3e6ea;padding:.6em}figcaption{font-size:13px}
"""


def campaign_page(
    result: CampaignResult,
    more: Findings,
    made: Iterable[Table],
    plots: Sequence[tuple[str, Path]],
    folder: Path,
    progress: Progress | None = None,
) -> str:
    """Return the page of a campaign.

    Args:
        made: tables of the report.
        plots: captions and files of the plots.
        folder: of the logs; episodes without one are named alone.
        progress: called with pictures of failures done and pictures in all.

    Raises:
        DataError: a log is damaged.
    """
    parts = [f"<h1>{_safe(result.plan.name)}</h1>", *map(_table, made)]
    for about, path in plots:
        parts.append(f"<h2>{_safe(about)}</h2>{_image(path.read_bytes(), about)}")
    failed = failures(result.results, more)
    if shown := failed[:_MOST]:
        figures = []
        for one in shown:
            figures.append(_failure(one, more, folder))
            if progress is not None:
                progress(len(figures), len(shown))
        parts.append(f"<h2>Failures</h2><p>{len(shown)} of {len(failed)}.</p>" + _LEGEND)
        parts.append(f'<div class="failures">{"".join(figures)}</div>')
    head = f'<meta charset="utf-8"><meta name="generator" content="dsrc drive"><title>{_safe(result.plan.name)}</title>'
    head += f"<style>{_STYLE}</style>"
    return f"<!doctype html><html lang=en><head>{head}</head><body>{''.join(parts)}</body></html>\n"


_LEGEND = (
    '<p class="note">Each from above at its end, 76 m wide: the ego blue, whom it touched orange, both with their '
    "ways; tracks dashed, false reports dotted. Dots on the ego's way are the instants of the cause.</p>"
)


def failures(results: Sequence[EpisodeResult], more: Findings) -> list[EpisodeResult]:
    """Return the episodes that failed, first those that broke against the baseline, then the hardest crashes."""
    broken = {one.now.key for one in more.gate.changes if one.kind == "broken" and one.now is not None}

    def order(one: EpisodeResult) -> tuple[bool, float]:
        hard = metric(one, "delta_v_mps")
        return one.key not in broken, -hard if hard == hard else 0.0

    return sorted((one for one in results if one.outcome in _FAILED), key=order)


def _failure(one: EpisodeResult, more: Findings, folder: Path) -> str:
    """Return the figure of an episode: its picture, what it is, how it ended and why."""
    from dsrc.closed_loop.report.picture import picture
    from dsrc.tables.figure import png_bytes

    path, cause = folder / f"{one.key}.npz", more.causes.get(one.key)
    image = ""
    if path.is_file() and len(log := EpisodeLog.load(path)):
        image = _image(png_bytes(picture(log, cause), dpi=80), episode_name(one))
    why = one.message or (cause.sentence if cause is not None else "")
    words = f"<b>{_safe(episode_name(one))}</b><br>{_safe(': '.join(filter(None, (one.outcome, why))))}"
    return f"<figure>{image}<figcaption>{words}<br><small>episodes/{_safe(one.key)}.npz</small></figcaption></figure>"


def _table(one: Table) -> str:
    title, note = f"<h2>{_safe(one.title)}</h2>" if one.title else "", one.note
    return f"{title}{one.html()}{f'<p class=note>{_safe(note)}</p>' if note else ''}"


def _image(png: bytes, about: str) -> str:
    return f'<img alt="{_safe(about)}" src="data:image/png;base64,{base64.b64encode(png).decode()}">'


def _safe(text: str) -> str:
    return html.escape(text)
