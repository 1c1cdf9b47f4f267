"""Files of each format, whole and damaged, as arguments of doors that take a path."""

import atexit
import gzip
import io
import json
import os
import shutil
import tempfile
import zipfile
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
from hypothesis import strategies as st
from hypothesis.strategies import SearchStrategy

from tests.fuzz.core import Parameter

FOLDER = Path(tempfile.gettempdir()) / f"jaxsimp-fuzz-{os.getpid()}"
"""Folder of the files of all inputs of this process, each replaced by the next."""
atexit.register(shutil.rmtree, FOLDER, ignore_errors=True)


@dataclass(frozen=True)
class FileCase:
    """A file: its name, its bytes (None for no file), and how it was damaged ("" for whole)."""

    name: str
    content: bytes | None
    damage: str = ""
    source: str = ""

    @property
    def short(self) -> str:
        """The file as a short text."""
        size = "missing" if self.content is None else f"{len(self.content)} bytes"
        head = "" if self.content is None else f" {self.content[:24]!r}"
        return f"<{self.name}: {self.source or 'file'}, {self.damage or 'whole'}, {size}{head}>"

    @property
    def spellings(self) -> set[str]:
        """What a message may call it."""
        return {self.name}

    def path(self) -> Path:
        """The path of the file, written now."""
        FOLDER.mkdir(exist_ok=True)
        path = FOLDER / self.name
        if path.is_dir():
            path.rmdir()
        path.unlink(missing_ok=True)
        if self.damage == "a folder":
            path.mkdir()
        elif self.content is not None:
            path.write_bytes(self.content)
        return path


Mutation = Callable[[bytes, Random], bytes]


def _flip(content: bytes, random: Random) -> bytes:
    changed = bytearray(content)
    for _ in range(random.choice((1, 1, 1, 8, 64))):
        if changed:
            changed[random.randrange(len(changed))] ^= 1 << random.randrange(8)
    return bytes(changed)


def _truncate(content: bytes, random: Random) -> bytes:
    return content[: random.randrange(len(content) + 1)]


def _insert(content: bytes, random: Random) -> bytes:
    place = random.randrange(len(content) + 1)
    return content[:place] + random.randbytes(random.choice((1, 4, 300))) + content[place:]


def _repeat(content: bytes, random: Random) -> bytes:
    start, end = sorted(random.randrange(len(content) + 1) for _ in range(2))
    return content[:end] + content[start:]


def _remove(content: bytes, random: Random) -> bytes:
    start = random.randrange(len(content) + 1)
    return content[:start] + content[start + random.choice((1, 4, 40)) :]


def _number(content: bytes, random: Random) -> bytes:
    """A number of a text becomes another."""
    words = content.split(b" ")
    places = [i for i, word in enumerate(words) if word[:1] in b"0123456789-." and word]
    if places:
        odd = (b"nan", b"inf", b"1e300", b"-1", b"0", b"99999999999", b"1e16", b"x", b"")
        words[random.choice(places)] = random.choice(odd)
    return b" ".join(words)


MUTATIONS: dict[str, Mutation] = {
    "flipped bits": _flip,
    "truncated": _truncate,
    "inserted bytes": _insert,
    "a repeated part": _repeat,
    "a removed part": _remove,
    "another number": _number,
    "empty": lambda content, random: b"",
    "noise": lambda content, random: random.randbytes(300),
    "utf-16": lambda content, random: content.decode("latin-1").encode("utf-16"),
    "a latin-1 byte": lambda content, random: b"# caf\xe9\n" + content,
    "a byte order mark": lambda content, random: b"\xef\xbb\xbf" + content,
    "carriage returns": lambda content, random: content.replace(b"\n", b"\r\n"),
    "gzip": lambda content, random: gzip.compress(content, mtime=0),
    "swapped members": lambda content, random: _members(content, random),
}


def _members(content: bytes, random: Random) -> bytes:
    """The members of a zip file under each other's names."""
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as file:
            members = {name: file.read(name) for name in file.namelist()}
    except zipfile.BadZipFile:
        return _flip(content, random)
    names = list(members)
    random.shuffle(names)
    return zipped(dict(zip(names, members.values(), strict=True)))


def zipped(members: dict[str, bytes]) -> bytes:
    """A zip file of members, the same for the same members."""
    written = io.BytesIO()
    with zipfile.ZipFile(written, "w", zipfile.ZIP_DEFLATED) as file:
        for name, content in members.items():
            file.writestr(zipfile.ZipInfo(name), content, zipfile.ZIP_DEFLATED)
    return written.getvalue()


def npy(array: Any) -> bytes:
    """An array as `.npy`."""
    written = io.BytesIO()
    np.save(written, array, allow_pickle=True)
    return written.getvalue()


def npz(**arrays: Any) -> bytes:
    """Arrays as `.npz`."""
    return zipped({f"{name}.npy": npy(array) for name, array in arrays.items()})


def bomb(*names: str) -> bytes:
    """A small `.npz` whose arrays are said to be large, and are in part: 64 MiB of zeros."""
    head = npy(np.zeros((4, 3)))[:128].replace(b"(4, 3)", b"(2796202, 3)", 1)
    head = head[:-8] + b"      \n" if len(head) > 128 else head
    return zipped({f"{name}.npy": head[:128] + bytes(2**26) for name in names})


def as_json(value: Any) -> bytes:
    """A value as JSON."""
    return json.dumps(value).encode()


def mesh_files(points: np.ndarray, faces: np.ndarray) -> dict[str, bytes]:
    """A mesh in each format, by suffix."""
    import trimesh

    mesh = trimesh.Trimesh(points, faces, process=False)
    files = {}
    for kind in ("obj", "ply", "stl", "off", "glb"):
        content = mesh.export(file_type=kind)
        files[f".{kind}"] = content.encode() if isinstance(content, str) else bytes(content)
    return files


def files(
    whole: Iterable[tuple[str, str, bytes]], odd: Iterable[tuple[str, str, bytes]] = ()
) -> Parameter:
    """A parameter that is a file: whole ones, and hostile ones.

    Args:
        whole: suffix, source, and content of valid files.
        odd: the same of files that are written well and not valid.
    """
    whole, odd = tuple(whole), tuple(odd)
    valid = st.sampled_from([FileCase(f"fuzz{end}", data, "", kind) for end, kind, data in whole])
    wrong = [FileCase(f"fuzz{end}", data, "odd", kind) for end, kind, data in odd]
    wrong.append(FileCase(f"fuzz{whole[0][0]}", None, "missing"))
    wrong.append(FileCase(f"fuzz{whole[0][0]}", b"", "a folder"))
    damaged = _damaged(whole)
    suffixes = st.sampled_from((".npz", ".npy", ".obj", ".usd", ".txt", "", ".zip", ".NPZ"))
    renamed = st.builds(
        lambda case, end: FileCase(f"fuzz{end}", case.content, "another suffix", case.source),
        valid,
        suffixes,
    )
    hostile = st.one_of(damaged, damaged, damaged, st.sampled_from(wrong), renamed)
    return Parameter(valid, hostile, optional=False)


def _damaged(whole: tuple[tuple[str, str, bytes], ...]) -> SearchStrategy[FileCase]:
    def damaged(file: tuple[str, str, bytes], kind: str, seed: int) -> FileCase:
        end, source, content = file
        return FileCase(f"fuzz{end}", MUTATIONS[kind](content, Random(seed)), kind, source)

    kinds = st.sampled_from(list(MUTATIONS))
    return st.builds(damaged, st.sampled_from(whole), kinds, st.integers(0, 10**6))


def on_disk(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function, with files written and replaced by their paths."""

    def called(**arguments: Any) -> Any:
        return function(
            **{
                name: value.path() if isinstance(value, FileCase) else value
                for name, value in arguments.items()
            }
        )

    return called
