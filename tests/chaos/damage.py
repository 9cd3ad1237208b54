"""Ways to damage the files of a run, by accident and on purpose."""

import hashlib
import itertools
import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from headway.storage import files

NEWEST = "manifests/iteration-001.json"


def run_files(root: Path) -> list[str]:
    """The files that the newest iteration stands on, and its manifest."""
    listed = json.loads((root / NEWEST).read_text())["files"]
    return [*listed, NEWEST]


def cut(content: bytes, rng: np.random.Generator, count: int) -> Iterator[bytes]:
    for place in rng.choice(len(content), min(count, len(content)), replace=False):
        yield content[:place]


def flipped(content: bytes, rng: np.random.Generator, count: int) -> Iterator[bytes]:
    for _ in range(count):
        changed = bytearray(content)
        changed[rng.integers(len(content))] ^= 1 << rng.integers(8)
        yield bytes(changed)


def replaced(content: bytes, rng: np.random.Generator, count: int) -> Iterator[bytes]:
    """Other bytes in one place, zeros (a block that was never written), or more bytes."""
    for _ in range(count):
        place = rng.integers(len(content))
        yield content[:place] + rng.bytes(16) + content[place + 16 :]
        yield content[:place] + bytes(len(content) - place - 1) + b"\1"


def accidents(root: Path, name: str) -> Iterator[bytes]:
    """What a file may hold after an accident; never what it held before."""
    rng = np.random.default_rng(0)
    whole = (root / name).read_bytes()
    swapped = {(root / other).read_bytes() for other in run_files(root)}
    broken = itertools.chain(
        cut(whole, rng, 20), flipped(whole, rng, 60), replaced(whole, rng, 8), sorted(swapped)
    )
    return (content for content in broken if content != whole)


def reseal(root: Path, name: str, content: bytes) -> None:
    """Change a file and make all checksums fit, as somebody would who means harm."""
    (root / name).write_bytes(content)
    if name == NEWEST:
        return
    manifest = json.loads((root / NEWEST).read_text())
    manifest.pop("checksum")
    manifest["files"][name] = {
        "bytes": len(content),
        "sha256": hashlib.sha256(content).hexdigest(),
    }
    (root / NEWEST).write_bytes(files.seal(manifest))


def sealed(values: dict) -> bytes:
    """A sealed document, of values that `files.seal` would not write either."""
    values.pop("checksum", None)

    def text(table):
        return (json.dumps(table, indent=2) + "\n").encode()

    return text({**values, "checksum": hashlib.sha256(text(values)).hexdigest()})


def with_header(header: bytes, data: bytes = b"", length: int | None = None) -> bytes:
    """A safetensors file with any header."""
    size = len(header) if length is None else length
    return size.to_bytes(8, "little") + header + data


DEEP = b"[" * 100_000 + b"]" * 100_000
HEADERS = {
    "a length of 1 TiB": with_header(b"{}", length=2**40),
    "the largest length": with_header(b"{}", length=2**64 - 1),
    "an array of 1 TiB": with_header(
        b'{"a":{"dtype":"F32","shape":[274877906944],"data_offsets":[0,1099511627776]}}'
    ),
    "a shape whose product overflows": with_header(
        b'{"a":{"dtype":"F32","shape":[4294967296,4294967296],"data_offsets":[0,4]}}', bytes(4)
    ),
    "a negative size": with_header(
        b'{"a":{"dtype":"F32","shape":[-1,-1],"data_offsets":[0,4]}}', bytes(4)
    ),
    "a negative offset": with_header(
        b'{"a":{"dtype":"F32","shape":[1],"data_offsets":[-4,0]}}', bytes(4)
    ),
    "arrays that overlap": with_header(
        b'{"a":{"dtype":"F32","shape":[1],"data_offsets":[0,4]},'
        b'"b":{"dtype":"F32","shape":[1],"data_offsets":[0,4]}}',
        bytes(8),
    ),
    "a gap": with_header(b'{"a":{"dtype":"F32","shape":[1],"data_offsets":[4,8]}}', bytes(8)),
    "bytes behind the end": with_header(
        b'{"a":{"dtype":"F32","shape":[1],"data_offsets":[0,4]}}', bytes(400)
    ),
    "an unknown type": with_header(
        b'{"a":{"dtype":"object","shape":[1],"data_offsets":[0,4]}}', bytes(4)
    ),
    "a type that is no text": with_header(
        b'{"a":{"dtype":["F32"],"shape":[1],"data_offsets":[0,4]}}', bytes(4)
    ),
    "a shape that is no list": with_header(
        b'{"a":{"dtype":"F32","shape":"1","data_offsets":[0,4]}}', bytes(4)
    ),
    "a size that is no whole number": with_header(
        b'{"a":{"dtype":"F32","shape":[1.0],"data_offsets":[0,4]}}', bytes(4)
    ),
    "a size that is true": with_header(
        b'{"a":{"dtype":"F32","shape":[true],"data_offsets":[0,4]}}', bytes(4)
    ),
    "a name twice": with_header(
        b'{"a":{"dtype":"F32","shape":[1],"data_offsets":[0,4]},'
        b'"a":{"dtype":"F32","shape":[1],"data_offsets":[0,4]}}',
        bytes(4),
    ),
    "thousands of axes": with_header(
        b'{"a":{"dtype":"F32","shape":[' + b"1," * 9999 + b'1],"data_offsets":[0,4]}}', bytes(4)
    ),
    "no number": with_header(b'{"a":{"dtype":"F32","shape":[NaN],"data_offsets":[0,4]}}', bytes(4)),
    "a number of a million digits": with_header(
        b'{"a":{"dtype":"F32","shape":[' + b"9" * 10**6 + b'],"data_offsets":[0,4]}}', bytes(4)
    ),
    "deep nesting": with_header(DEEP),
    "a list": with_header(b"[]"),
    "no JSON": with_header(b"{"),
    "no text": with_header(b"\xff\xfe"),
    "nothing at all": b"",
    "no header": bytes(7),
    "nine million spaces": with_header(b"{}" + b" " * 9_000_000),
}

NUMBERS = [b"NaN", b"Infinity", b"-Infinity", b"1e999", b"9" * 5000, b"9" * 10**6, b"-" + b"9" * 99]
DOCUMENTS = {
    "nothing": b"",
    "spaces": b" " * 1000,
    "no JSON": b"{",
    "a list": b"[]",
    "a number": b"7",
    "deep lists": DEEP,
    "deep tables": b'{"a":' * 100_000 + b"1" + b"}" * 100_000,
    "a key twice": b'{"schema": 2, "schema": 2}',
    "no text": b"\xff\xfe\x00",
    "a zero byte": b'{"schema": 2}\0',
    "millions of lists": b"[" + b"[]," * 3_000_000 + b"[]]",
    **{f"the number {text[:9].decode()}": b'{"schema": ' + text + b"}" for text in NUMBERS},
}
