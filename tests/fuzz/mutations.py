"""Mutations of files: of bytes, of text, of arrays and of tensors."""

import io
import json
import re
import zipfile
from pathlib import Path

import numpy as np
import torch

Rng = np.random.Generator

VALUES = (
    *("0", "-1", "1e308", "-1e308", "nan", ".nan", "inf", ".inf", "NaN", "null", "true", "{}", "[]", '""', "''", "~"),
    *("9" * 400, "9" * 5000, "-" + "9" * 25, "1e99999", "0x", "2147483648", "9223372036854775808", "1.5", "1e-320"),
    *(
        "!!bool x",
        "!!int x",
        "!!float ''",
        "!!timestamp 2",
        "!!binary x",
        "!!set x",
        "!!python/tuple [1]",
        "*a",
        "&a b",
    ),
    *(
        "!!python/object/apply:os.system ['touch owned']",
        "<<",
        "\\u0000",
        '"\\ud800"',
        '"\\u0000"',
        "\0",
        "ä",
        "x" * 300,
    ),
    *("[" * 300, "[" * 100_000, "{a: " * 5000, "- " * 50_000, '{"a":' * 50_000, "[[1], 2]", "a,b", '"' + "y" * 200_000),
)
_NUMBER = re.compile(r"-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")
_WORD = re.compile(r"[A-Za-z_][\w.]*")


def alias_bomb(depth: int = 9, width: int = 9) -> str:
    """Return a YAML of a few hundred bytes whose aliases stand for width ** depth values."""
    lines = ["a0: &a0 [x, x, x]"]
    lines += [f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * width)}]" for k in range(1, depth)]
    return "\n".join(lines) + "\n"


def of_bytes(content: bytes, rng: Rng) -> bytes:
    """Change, repeat, remove or add some bytes."""
    data = bytearray(content)
    for _ in range(int(rng.integers(1, 4))):
        at = int(rng.integers(len(data) + 1))
        match int(rng.integers(7)):
            case 0 if data:
                data[at % len(data)] ^= 1 << int(rng.integers(8))
            case 1 if data:
                size = int(rng.choice([1, 2, 4, 8]))
                data[at : at + size] = rng.choice([b"\0", b"\xff", b"\x7f", b"\x80"]) * size
            case 2:
                del data[at:]
            case 3:
                del data[at : at + int(rng.integers(1, 200))]
            case 4:
                data[at:at] = data[at : at + int(rng.integers(1, 200))]
            case 5:
                data[at:at] = rng.bytes(int(rng.integers(1, 50)))
            case _:
                data[at:at] = str(rng.choice(VALUES)).encode("utf-8", "replace")
    return bytes(data)


def of_text(content: bytes, rng: Rng) -> bytes:
    """Replace a number, a word or a line by something that a parser may stumble over."""
    text = content.decode("utf-8", "replace")
    for _ in range(int(rng.integers(1, 3))):
        kind = int(rng.integers(8))
        found = list((_NUMBER if kind < 4 else _WORD).finditer(text[:200_000]))
        value = str(VALUES[int(rng.integers(len(VALUES)))])
        if kind < 6 and found:
            start, end = found[int(rng.integers(len(found)))].span()
            text = text[:start] + value + text[end:]
        elif kind == 6:
            lines = text.split("\n")
            row, other = (int(rng.integers(len(lines))) for _ in range(2))
            lines[row] = rng.choice([lines[other], value, "", f"{lines[row]}\n{lines[row]}"])
            text = "\n".join(lines)
        else:
            text = rng.choice([alias_bomb(), text + alias_bomb(), value + text, text + value, value])
    return text.encode("utf-8", "replace")


def of_arrays(content: bytes, rng: Rng) -> bytes:
    """Replace or lie about an array of a .npz."""
    with np.load(io.BytesIO(content), allow_pickle=False) as archive:
        arrays = {name: archive[name] for name in archive.files}
    name = str(rng.choice(list(arrays)))
    array, kind, packing = arrays[name], int(rng.integers(14)), zipfile.ZIP_STORED
    lie: bytes | None = None
    match kind:
        case 0:
            arrays[name] = np.array(array.ravel()[0] if array.size else 0)
        case 1:
            arrays[name] = array[:0] if array.ndim else np.zeros(0, array.dtype)
        case 2:
            arrays[name] = np.full(array.shape, rng.choice([np.nan, np.inf, 1e308, -1e308]))
        case 3:
            arrays[name] = np.full(array.shape, rng.choice(["\ud800", "\0", "x" * 5000, "", "{}", "[1]"]))
        case 4 if array.dtype.kind in "iu":
            arrays[name] = np.full_like(array, rng.choice([np.iinfo(array.dtype).min, np.iinfo(array.dtype).max, 0, 1]))
        case 5:
            del arrays[name]
        case 6:
            arrays[name] = np.concatenate([np.atleast_1d(array)] * 2)
        case 7 if array.dtype.kind != "U":
            arrays[name] = array.astype(rng.choice(["f4", "f8", "i2", "U5", "S5", "c16", "?", "u1"]))
        case 8 if array.size:
            arrays[name] = array.copy()
            flat = arrays[name].reshape(-1)
            flat[int(rng.integers(flat.size))] = rng.integers(-3, 100) if array.dtype.kind in "if" else 1
        case 9:
            arrays[name] = array[None]
        case 10:
            shape = rng.choice(["(10000000000000,)", "(1000000, 1000000)", "(-1,)", "(0, 99999999999999)", "()"])
            kind_of = rng.choice(["<U0", "<f8", "|V0", "|O", "<i8"])
            header = f"{{'descr': '{kind_of}', 'fortran_order': False, 'shape': {shape}, }}"
            lie = b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header.encode("latin-1")
        case 11:
            arrays[name], packing = np.zeros(3 << 27), zipfile.ZIP_DEFLATED  # 3 GB in 3 MB
        case 12:
            arrays["extra"] = np.zeros(3)
        case _:
            if array.dtype.kind == "U" and array.ndim == 0:
                arrays[name] = np.array(
                    of_text(str(array).encode(), rng).decode("utf-8", "replace").rstrip("\0") or "x"
                )
    buffer = io.BytesIO()
    if packing == zipfile.ZIP_DEFLATED:
        return _bomb(arrays, name)
    with zipfile.ZipFile(buffer, "w", packing) as file:
        for key, value in arrays.items():
            member = io.BytesIO()
            np.lib.format.write_array(member, np.asarray(value), allow_pickle=False)
            file.writestr(f"{key}.npy", lie if lie is not None and key == name else member.getvalue())
    made = bytearray(buffer.getvalue())
    if kind == 13 and rng.random() < 0.3:  # encrypted, as the flags say
        for mark, place in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
            made[made.find(mark) + place] |= 1
    return bytes(made)


def _bomb(arrays: dict[str, np.ndarray], name: str) -> bytes:
    """Return an archive of which one member inflates to 3 GB."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as file:
        for key, value in arrays.items():
            with file.open(zipfile.ZipInfo(f"{key}.npy"), "w", force_zip64=True) as member:
                if key != name:
                    np.lib.format.write_array(member, np.asarray(value), allow_pickle=False)
                    continue
                np.lib.format.write_array_header_1_0(
                    member, {"descr": "<f8", "fortran_order": False, "shape": (3 << 27,)}
                )
                for _ in range(24):
                    member.write(bytes(1 << 20))
    return buffer.getvalue()


def of_tensors(content: bytes, rng: Rng) -> bytes:
    """Replace a setting or a tensor of a file of `torch.save`."""
    made = torch.load(io.BytesIO(content), weights_only=True)
    one = made["detectors"][-1] if "detectors" in made else made  # of a joined file the last
    state = one.get("state", one)
    name = str(rng.choice(list(state)))
    match int(rng.integers(10)):
        case 0:
            state[name] = torch.zeros(3, 3).to_sparse()
        case 1:
            state[name] = torch.zeros(1).expand(10_000_000, 10_000_000)
        case 2:
            state[name] = torch.full_like(state[name], torch.nan) if state[name].is_floating_point() else None
        case 3:
            state[name] = torch.empty_like(state[name], device="meta")  # as a file of another machine may hold
        case 4:
            state[name] = state[name][None]
        case 5:
            del state[name]
        case 6:
            state[name] = rng.choice(["text", "", "x" * 5000])
        case 7:
            state[f"{name}.{rng.integers(9)}"] = state[name]
        case _:
            if "settings" in one:
                one["settings"] = json.loads(_setting_changed(json.dumps(one["settings"]), rng))
    buffer = io.BytesIO()
    torch.save(made, buffer)
    return buffer.getvalue()


def _setting_changed(text: str, rng: Rng) -> str:
    numbers = list(_NUMBER.finditer(text))
    start, end = numbers[int(rng.integers(len(numbers)))].span()
    value = str(rng.choice(["0", "-1", "1e308", "1000000000", "99999999999999999999999", "65536", '"x"', "null", "[]"]))
    return text[:start] + value + text[end:]


def mutated(path: Path, kind: str, rng: Rng) -> bytes:
    """Return the content of a file after a mutation that suits its kind: bytes, text, arrays or tensors."""
    content = path.read_bytes()
    special = {"text": of_text, "arrays": of_arrays, "tensors": of_tensors}.get(kind)
    # Half of the mutations know the format: those of bytes seldom get past the first check.
    return special(content, rng) if special is not None and rng.random() < 0.6 else of_bytes(content, rng)
