"""Files that are damaged as files: cut, flipped bits, missing pieces, words of the text exchanged."""

import re
from collections.abc import Callable
from pathlib import Path

from .damage import NAN, ODD_DOUBLES, ODD_INTS
from .mutant import Draft, Kind

TIMED = ("sparse", "rounded", "curtain", "loops")
"""Shots whose garments are not solved at their own samples alone."""
ALL = ("plain", "still", "dressed", "bodies", "skinned", "layered", "several", "instanced", "clips", *TIMED)
_NUMBER = re.compile(rb"(?<![\w.])-?\d+(?:\.\d+)?(?:e[-+]?\d+)?(?![\w.])")
_WORD = re.compile(rb"[A-Za-z_][\w:]*")
_TYPES = (b"int[]", b"float[]", b"point3f[]", b"string", b"token", b"double", b"matrix4d", b"quatf[]", b"half3[]")
_TYPED = re.compile(rb"(?<=\s)(?:int|float|point3f|string|token|double|matrix4d|quatf|half3|bool)(?:\[\])?(?=\s)")


def _cut(draft: Draft, data: bytes) -> bytes:
    return data[: int(draft.rng.integers(len(data)))]


def _flip_bits(draft: Draft, data: bytes) -> bytes:
    out = bytearray(data)
    for _ in range(draft.pick([1, 1, 2, 8, 64])):
        out[int(draft.rng.integers(len(out)))] ^= 1 << int(draft.rng.integers(8))
    return bytes(out)


def _flip_tail(draft: Draft, data: bytes) -> bytes:
    """A crate's tables are at its end and its header at its beginning; values lie between."""
    out = bytearray(data)
    for _ in range(draft.pick([1, 2, 4])):
        part = range(88) if draft.chance(0.3) else range(max(len(out) - 700, 0), len(out))
        out[part[int(draft.rng.integers(len(part)))]] ^= 1 << int(draft.rng.integers(8))
    return bytes(out)


def _blank(draft: Draft, data: bytes) -> bytes:
    start = int(draft.rng.integers(len(data)))
    length = int(draft.pick([4, 16, 64, 512]))
    filler = draft.pick([b"\0", b"\xff", b" "])
    return data[:start] + filler * len(data[start : start + length]) + data[start + length :]


def _move_block(draft: Draft, data: bytes) -> bytes:
    a, b = sorted(int(i) for i in draft.rng.integers(len(data), size=2))
    block = data[a : a + draft.pick([8, 32, 256])]
    return draft.pick([data[:b] + block + data[b:], data[:a] + data[a + len(block) :], data[:b] + block])


def _change_number(draft: Draft, data: bytes) -> bytes:
    found = list(_NUMBER.finditer(data))
    for match in sorted((draft.pick(found) for _ in range(draft.pick([1, 1, 3]))), key=lambda m: -m.start()):
        word = draft.pick([f"{draft.pick(ODD_DOUBLES):g}", str(draft.pick(ODD_INTS)), "", "x", f"{NAN}, {NAN}"])
        data = data[: match.start()] + word.encode() + data[match.end() :]
    return data


def _change_type(draft: Draft, data: bytes) -> bytes:
    found = list(_TYPED.finditer(data))
    if not found:
        return data + b"float x = 1"
    match = draft.pick(found)
    return data[: match.start()] + draft.pick(_TYPES) + data[match.end() :]


def _change_word(draft: Draft, data: bytes) -> bytes:
    found = list(_WORD.finditer(data))
    match, other = draft.pick(found), draft.pick(found)
    return data[: match.start()] + draft.pick([other.group(), b"", b"x"]) + data[match.end() :]


def _change_lines(draft: Draft, data: bytes) -> bytes:
    lines = data.split(b"\n")
    a, b = (int(i) for i in draft.rng.integers(len(lines), size=2))
    how = draft.pick(["drop", "double", "swap", "move"])
    if how == "drop":
        del lines[a : a + draft.pick([1, 1, 2, 10])]
    elif how == "double":
        lines.insert(b, lines[a])
    elif how == "swap":
        lines[a], lines[b] = lines[b], lines[a]
    else:
        lines.insert(b % len(lines), lines.pop(a))
    return b"\n".join(lines)


def _change_bracket(draft: Draft, data: bytes) -> bytes:
    where = [index for index, byte in enumerate(data) if byte in b"()[]{}<>@\"'="]
    at = draft.pick(where)
    return data[:at] + draft.pick([b"", data[at : at + 1] * 2, b"(", b"]", b"}", b"None"]) + data[at + 1 :]


def _in_bytes(change: Callable[[Draft, bytes], bytes], *, crate: bool) -> Callable[[Draft], None]:
    """A mutation that changes the bytes of one of the shot's files."""

    def mutate(draft: Draft) -> None:
        if crate:
            draft.as_crate()
        file = draft.shot if crate else draft.pick(draft.files())
        data = file.read_bytes()
        file.write_bytes(change(draft, data))
        draft.said.append(f"{change.__name__.strip('_')} in {file.name} ({len(data)} bytes)")

    return mutate


def _no_file(draft: Draft) -> None:
    """A file that is empty, of another kind, a folder, a link to itself, or not there."""
    file = draft.pick(draft.files())
    how = draft.pick(["empty", "picture", "folder", "link", "missing", "crate by name", "text by name", "blank"])
    data = file.read_bytes()
    file.unlink()
    if how == "link":
        file.symlink_to(file.name)
    elif how == "folder":
        file.mkdir()
    elif how == "text by name":
        if file == draft.shot:
            draft.name = "shot.usdc"
        file.with_suffix(".usdc").write_bytes(data)
    elif how != "missing":
        made = {"empty": b"", "picture": b"\x89PNG\r\n\x1a\n" + bytes(64), "crate by name": b"PXR-USDC" + bytes(80)}
        file.write_bytes(made.get(how, b"#usda 1.0\n"))
    draft.said.append(f"{file.name} is {how}")


def _text(change: Callable[[Draft, bytes], bytes], bases: tuple[str, ...] = ALL) -> Kind:
    return Kind(f"text: {change.__name__.strip('_').replace('_', ' ')}", _in_bytes(change, crate=False), bases)


def _crate(change: Callable[[Draft, bytes], bytes]) -> Kind:
    name = f"crate: {change.__name__.strip('_').replace('_', ' ')}"
    return Kind(name, _in_bytes(change, crate=True), ALL, in_process=False)


KINDS = (
    *(_text(each) for each in (_cut, _flip_bits, _blank, _move_block, _change_number, _change_type)),
    *(_text(each) for each in (_change_word, _change_lines, _change_bracket)),
    *(_crate(each) for each in (_cut, _flip_bits, _flip_tail, _blank, _move_block)),
    Kind("file: none", _no_file, ALL),
)


def sizes(folder: Path) -> dict[str, bytes]:
    """Contents of the files of a folder, by name."""
    return {
        file.name: file.read_bytes() for file in sorted(folder.iterdir()) if file.is_file() and not file.is_symlink()
    }
