"""Mutated files through every reader: `python -m benchmarks.fuzz [KIND ...] --files 1500 --seed 0`.

A file of each kind is made, changed at random (bytes, pages, cells, JSON values, rows of a map's database), and read by
what reads it in use. Allowed are the same content as before and a one-line error; for files without checksums also
another content. A traceback is a defect; so is a map that reads differently without a word. The same seed makes the
same files. Exit code 1 if anything of that kind was found.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import io
import json
import random
import shutil
import sqlite3
import struct
import sys
import tempfile
import traceback
import warnings
import zipfile
import zlib
from collections import Counter
from collections.abc import Callable, Iterator
from copy import deepcopy
from dataclasses import dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from evermap.errors import EvermapError, printable

Mutate = Callable[[bytes, random.Random], bytes]
NASTY_NUMBERS: tuple[Any, ...] = (
    float("nan"), float("inf"), -float("inf"), 0, -0.0, -1, 1e308, -1e308, 5e-324, 2**31, 2**63, -(2**63), 2**64,
    10**400, 0.5, 1.5, 1e-9, 3_000_000_000, True,
)  # fmt: skip
NASTY_VALUES: tuple[Any, ...] = (
    *NASTY_NUMBERS, None, "", "x", "inf", "nan", "\x1b[31m", "$\\foo$", "[/red]", "\ud800", "é" * 3000, [], [[]], {},
    [1], [[0, 1], [1]], [None], {"a": 1}, {"lifetime": "Exponential"}, {"lifetime": "Mixture", "components": []},
)  # fmt: skip
NASTY_BYTES = (
    b"nan", b"inf", b"-inf", b"1e999", b"-1", b"", b",", b'"', b"'", b"\n", b"\r", b"\0", b"\xff\xfe", b"\x1b[31m",
    b"#",     b"9" * 5000, b"[" * 3000, b"[" * 3000 + b"]" * 3000, b"{" * 2000, b"a.b.c=", b"1_000", b"0x10",
    b"99999999999999999999",     b"1e308", b"true", b"1979-05-27", b"\xe2\x80\xae", b"=" * 50,
)  # fmt: skip


@dataclass(frozen=True)
class Kind:
    """A kind of file.

    Attributes:
        suffix: of the file's name.
        originals: contents to start from.
        mutate: changes one.
        read: reads a file as it is read in use; what it returns tells whether two contents are the same.
        checked: whether another content than the original's is a defect, because the file has checksums.
    """

    suffix: str
    originals: tuple[bytes, ...]
    mutate: Mutate
    read: Callable[[Path], Any]
    checked: bool = False


def run(kind: Kind, files: int, seed: int, folder: Path, *, verbose: bool = False) -> Counter[str]:
    """How many files ended how: 'same', 'other', 'line', and the defects 'traceback', 'silent' and 'long line'."""
    counts: Counter[str] = Counter()
    expected = []
    for number, original in enumerate(kind.originals):
        path = folder / f"original{number}{kind.suffix}"
        path.write_bytes(original)
        expected.append(kind.read(path))
    path = folder / f"mutated{kind.suffix}"
    for number in range(files):
        dice = random.Random(f"{seed}/{number}")
        which = dice.randrange(len(kind.originals))
        path.write_bytes(kind.mutate(kind.originals[which], dice))
        ending = _ending(kind, path, expected[which])
        counts[ending.partition("\n")[0]] += 1
        if verbose and ending.startswith(("traceback", "silent", "long")):
            print(f"file {number}: {ending}")
            shutil.copy(path, folder.parent / f"defect-{number}{kind.suffix}")
        for rest in folder.glob(f"{path.name}?*"):
            rest.unlink()
    return counts


def _ending(kind: Kind, path: Path, expected: Any) -> str:
    try:
        with warnings.catch_warnings(), contextlib.redirect_stderr(io.StringIO()):
            warnings.simplefilter("ignore")
            found = kind.read(path)
    except EvermapError as error:
        line = error.one_line()
        return "line" if printable(line) == line and len(line) < 2500 else f"long line\n{line[:300]!r}"
    except Exception:
        return "traceback\n" + traceback.format_exc(limit=-4)
    if found == expected:
        return "same"
    return f"silent\n{path}" if kind.checked else "other"


# ---------------------------------------------------------------------------------------------- how files are changed


def flip(data: bytes, dice: random.Random) -> bytes:
    """Bytes, runs and lengths."""
    content = bytearray(data)
    for _ in range(dice.choice((1, 1, 2, 5, 20))):
        at = dice.randrange(len(content)) if content else 0
        match dice.randrange(7):
            case 0 | 1 if content:
                content[at] = dice.randrange(256)
            case 2 if content:
                content[at] ^= 1 << dice.randrange(8)
            case 3:
                del content[at : at + dice.choice((1, 4, 100))]
            case 4:
                content[at:at] = content[at : at + dice.choice((1, 10, 1000))]
            case 5:
                content = content[:at] if dice.random() < 0.3 else content
            case _:
                content[at : at + dice.choice((1, 8))] = bytes(dice.choice((0, 255)) for _ in range(8))
    return bytes(content)


def edit_text(data: bytes, dice: random.Random) -> bytes:
    """Cells, words and lines of a text."""
    if dice.random() < 0.2:
        return flip(data, dice)
    for _ in range(dice.choice((1, 1, 2, 4))):
        import re

        words = list(re.finditer(rb"[^\s,=\[\]\"{}:]+", data))
        lines = data.split(b"\n")
        at = dice.randrange(len(lines))
        match dice.randrange(6):
            case 0 | 1 | 2 if words:
                word = dice.choice(words)
                data = data[: word.start()] + dice.choice(NASTY_BYTES) + data[word.end() :]
            case 3:
                data = b"\n".join(lines[:at] + lines[at + 1 :])
            case 4:
                data = b"\n".join([*lines[: at + 1], lines[at], *lines[at + 1 :]])
            case _:
                spot = dice.randrange(len(data) + 1)
                data = data[:spot] + dice.choice(NASTY_BYTES) + data[spot:]
    return data


def edit_json(data: bytes, dice: random.Random) -> bytes:
    """Values anywhere in a JSON document."""
    if dice.random() < 0.15:
        return edit_text(data, dice)
    document = json.loads(data)
    for _ in range(dice.choice((1, 1, 2, 3))):
        spots = list(_spots(document))
        if not spots:
            break
        holder, key = dice.choice(spots)
        match dice.randrange(5):
            case 0:
                if isinstance(holder, dict):
                    del holder[key]
                else:
                    holder.pop(key)
            case 1 if isinstance(holder, list):
                holder.append(deepcopy(dice.choice(NASTY_VALUES)))
            case 2 if isinstance(holder[key], int | float) and not isinstance(holder[key], bool):
                holder[key] = dice.choice(NASTY_NUMBERS)
            case _:
                holder[key] = deepcopy(dice.choice(NASTY_VALUES))
    text = json.dumps(document)
    if dice.random() < 0.05:
        text = text.replace("1", "1" * 5000, 1)
    if dice.random() < 0.03:
        depth = dice.choice((50, 900, 5000))
        text = text.replace(": [", ": " + "[" * depth + "]" * depth + ', "x": [', 1)
    return text.encode()


def _spots(document: Any) -> Iterator[tuple[Any, Any]]:
    keys = list(document) if isinstance(document, dict) else range(len(document)) if isinstance(document, list) else ()
    for key in keys:
        yield document, key
        yield from _spots(document[key])


def edit_bag(data: bytes, dice: random.Random) -> bytes:
    """Numbers, lengths and texts in the messages of a bag, and bytes anywhere."""
    if dice.random() < 0.4:
        return flip(data, dice)
    content = bytearray(data)
    for _ in range(dice.choice((1, 1, 3, 10, 100))):
        at = dice.randrange(len(content) - 8)
        match dice.randrange(4):
            case 0:
                number = dice.choice(NASTY_NUMBERS)
                packed = struct.pack("<d", float(number) if abs(number) < 2**1023 else float("inf"))
                content[at : at + 8] = packed
            case 1:
                content[at : at + 4] = struct.pack("<I", dice.choice((0, 1, 7, 255, 2**16, 2**31, 2**32 - 1)))
            case 2:  # two messages, or parts of them, exchanged
                other, count = dice.randrange(len(content) - 8), dice.choice((8, 64, 500))
                content[at : at + count] = content[other : other + count].ljust(len(content[at : at + count]), b"\0")
            case _:
                content[at] = dice.choice(b"/_.aZ0\0\xff")
    return bytes(content)


def edit_parquet(data: bytes, dice: random.Random) -> bytes:
    """Columns with numbers that are none, of other types, missing or renamed; and bytes."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    if dice.random() < 0.3:
        return flip(data, dice)
    table = pq.read_table(pa.BufferReader(data))
    for _ in range(dice.choice((1, 1, 2))):
        at = dice.randrange(table.num_columns)
        name, column = table.column_names[at], table.column(at)
        cells = column.to_pylist()
        match dice.randrange(7):
            case 0 | 1 | 2:
                numbers = [float(min(max(c, -1e308), 1e308)) if isinstance(c, int | float) else 0.0 for c in cells]
                for _ in range(dice.choice((1, 3))):
                    value = dice.choice(NASTY_NUMBERS)
                    numbers[dice.randrange(len(numbers))] = float(value) if abs(value) < 2**1023 else float("inf")
                new = pa.array(numbers, pa.float64())
            case 3:
                new = pa.array(
                    [str(cell) if dice.random() < 0.9 else dice.choice(("", "inf", "é", "\x1b")) for cell in cells]
                )
            case 4:
                new = pa.array([None] * len(cells), dice.choice((pa.float64(), pa.int64(), pa.string(), pa.null())))
            case 5:
                new = dice.choice(
                    (
                        pa.array([[1.0]] * len(cells)),
                        pa.array([b"x"] * len(cells)),
                        pa.array([{"a": 1}] * len(cells)),
                        pa.array([2**63 + 5] * len(cells), pa.uint64()),
                        pa.array([0] * len(cells), pa.timestamp("ns")),
                        pa.array([True] * len(cells)),
                        pa.array(["a"] * len(cells)).dictionary_encode(),
                    )
                )
            case _:
                name, new = dice.choice((name + "x", "", "\x1b", name.upper())), column
        table = table.set_column(at, name, new)
    if dice.random() < 0.15:
        about = dice.choice((b"{", b"[]", b"[" * 5000, b'{"class_names": [1]}', b"\xff", b"1" * 5000))
        table = table.replace_schema_metadata({b"evermap": about})
    sink = io.BytesIO()
    pq.write_table(table, sink)
    return sink.getvalue()


def edit_zip(data: bytes, dice: random.Random) -> bytes:
    """Texts in an archive, and the archive."""
    if dice.random() < 0.3:
        return flip(data, dice)
    sink = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(data)) as old, zipfile.ZipFile(sink, "w", zipfile.ZIP_DEFLATED) as new:
        names = old.namelist()
        chosen = dice.choice(names)
        for name in names:
            content = old.read(name)
            if name == chosen:
                if dice.random() < 0.1:
                    continue
                content = edit_text(content, dice)
            new.writestr(name, content)
    return sink.getvalue()


def edit_map(data: bytes, dice: random.Random) -> bytes:
    """A map: bytes and pages of the file, or rows of its database, with or without matching names."""
    way = dice.random()
    if way < 0.25:
        content = bytearray(data)
        for _ in range(dice.choice((1, 1, 3, 20))):
            content[dice.randrange(len(content))] = dice.randrange(256)
        return bytes(content)
    if way < 0.33:
        return flip(data, dice)
    if way < 0.4:
        return data[: dice.randrange(len(data))]
    if way < 0.5:
        size, pages = 4096, len(data) // 4096
        at, other = dice.randrange(pages) * size, dice.randrange(pages) * size
        page = dice.choice((bytes(size), b"\xff" * size, data[other : other + size], dice.randbytes(size)))
        return data[:at] + page + data[at + size :]
    if way < 0.55:
        return dice.randbytes(100) + data[100:]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "m"
        path.write_bytes(data)
        with contextlib.closing(sqlite3.connect(path, isolation_level=None)) as database:
            if way < 0.8:
                _edit_rows(database, dice)
            else:
                _forge(database, dice)
        return path.read_bytes()


def _edit_rows(database: sqlite3.Connection, dice: random.Random) -> None:
    """Values that nobody wrote, in any table."""
    tables = [row[0] for row in database.execute("SELECT name FROM sqlite_master WHERE type = 'table'")]
    values: tuple[Any, ...] = (
        None, -1, 0, 1, 2, 3, 99, 2**62, 1.5, float("inf"), "x", "", b"", b"x" * 32, b"\0" * 32,
        "é", zlib.compress(b"{}"),
    )  # fmt: skip
    for _ in range(dice.choice((1, 1, 2))):
        table = dice.choice(tables)
        if not database.execute("SELECT count(*) FROM sqlite_master WHERE name = ?", (table,)).fetchone()[0]:
            continue  # dropped
        rows = [row[0] for row in database.execute(f"SELECT rowid FROM {table}")]
        names = [row[1] for row in database.execute(f"PRAGMA table_info({table})")]
        if not rows:
            continue
        row, name = dice.choice(rows), dice.choice(names)
        with contextlib.suppress(sqlite3.Error):
            match dice.randrange(6):
                case 0:
                    database.execute(f"DELETE FROM {table} WHERE rowid = ?", (row,))
                case 1:
                    other = dice.choice(rows)
                    database.execute(
                        f"UPDATE {table} SET {name} = (SELECT {name} FROM {table} WHERE rowid = ?) WHERE rowid = ?",
                        (other, row),
                    )
                case 2:
                    old = database.execute(f"SELECT {name} FROM {table} WHERE rowid = ?", (row,)).fetchone()[0]
                    new = flip(old, dice) if isinstance(old, bytes) else dice.choice(values)
                    database.execute(f"UPDATE {table} SET {name} = ? WHERE rowid = ?", (new, row))
                case 3:
                    database.execute(dice.choice((f"DROP TABLE {table}", f"ALTER TABLE {table} RENAME TO other")))
                case _:
                    database.execute(f"UPDATE {table} SET {name} = ? WHERE rowid = ?", (dice.choice(values), row))


def _forge(database: sqlite3.Connection, dice: random.Random) -> None:
    """Content that cannot be, under names and checksums that match: what only the checks of the content can find."""
    try:
        newest = database.execute("SELECT number, record FROM revision ORDER BY number DESC").fetchone()
        record = json.loads(_chunk(database, newest[1]))
        number, name = newest
    except (sqlite3.Error, json.JSONDecodeError, IndexError):  # of an older schema
        number, name = database.execute("SELECT number, content FROM revision ORDER BY number DESC").fetchone()
        record = None
    manifest = json.loads(_chunk(database, bytes.fromhex(record["content"]) if record else name))
    if record is not None and dice.random() < 0.35:
        _spoil(record, dice, keep=("content", "config", "parent_record"))
    else:
        kind = dice.randrange(4)
        column = dice.choice(sorted(manifest["columns"]))
        dtype, shape, _, names = manifest["columns"][column]
        if kind == 0:
            _spoil(manifest, dice, keep=())
        elif kind == 1:
            manifest["columns"][column][dice.randrange(3)] = dice.choice(
                ("<f8", "|O", "<i8", "|b1", "|u1", "nonsense", [1], [2**40], [-1], [3, 3], [0], [], True, None, [1.5])
            )
        elif kind == 2:
            manifest["columns"][column][3] = dice.choice((names[:-1], names + names, ["zz"], [None], "x", [names]))
        elif names and dtype in ("<f8", "<i8") and column != "lives.chunk":  # any whole number is a chunk
            count = int(np.prod(shape))
            bad = np.full(count, np.nan if dtype == "<f8" else -(2**62), dtype)
            manifest["columns"][column] = [dtype, shape, False, [_store(database, dtype, bad.tobytes()).hex()]]
    content = _store(database, "|u1", json.dumps(manifest).encode())
    if record is None:
        database.execute("UPDATE revision SET content = ? WHERE number = ?", (content, number))
        return
    if record.get("content") is not None:
        record["content"] = content.hex()
    forged = _store(database, "|u1", json.dumps(record).encode())
    database.execute("UPDATE revision SET record = ? WHERE number = ?", (forged, number))
    row = database.execute("SELECT schema_version, created_at, evermap_version, head FROM store").fetchone()
    sealed = hashlib.sha256(json.dumps([*row, forged.hex()]).encode()).digest()
    database.execute("UPDATE store SET record = ?, checksum = ?", (forged, sealed))


def _spoil(document: dict[str, Any], dice: random.Random, keep: tuple[str, ...]) -> None:
    """A value that cannot be in the place of another."""
    key = dice.choice([name for name in sorted(document) if name not in keep])
    old = document[key]
    if isinstance(old, dict) and old and dice.random() < 0.8:
        _spoil(old, dice, ())
    elif dice.random() < 0.2:
        del document[key]
    else:
        numbers = (int, float) if old is None or isinstance(old, float) else ()
        kinds = [value for value in NASTY_VALUES if type(value) not in (type(old), *numbers)]
        document[key] = deepcopy(dice.choice(kinds))


def _chunk(database: sqlite3.Connection, name: bytes) -> bytes:
    return zlib.decompress(database.execute("SELECT data FROM chunk WHERE name = ?", (name,)).fetchone()[0])


def _store(database: sqlite3.Connection, dtype: str, raw: bytes) -> bytes:
    name = hashlib.sha256(dtype.encode() + raw).digest()
    planes = np.frombuffer(raw, np.uint8).reshape(-1, np.dtype(dtype).itemsize).T.tobytes()
    database.execute("INSERT OR IGNORE INTO chunk (name, data) VALUES (?, ?)", (name, zlib.compress(planes)))
    return name


# ------------------------------------------------------------------------------------------------- how files are read


def plain(value: Any) -> Any:
    """Arrays, dataclasses and models as what can be compared."""
    if isinstance(value, np.ndarray):
        return value.dtype.str, value.shape, value.tobytes()
    if is_dataclass(value) and not isinstance(value, type):
        return type(value).__name__, tuple(plain(getattr(value, item.name)) for item in fields(value))
    if isinstance(value, dict):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return tuple(plain(item) for item in value)
    return repr(value) if isinstance(value, float) else None if isinstance(value, Path) else value


def read_map(path: Path) -> Any:
    """Everything in a map, as the commands read it. Where a revision is damaged, going back must work."""
    from evermap.maps.store import DamagedMapError, open_store, revert_store, verify_store

    told: EvermapError | None = None
    content: dict[Any, Any] = {}
    try:
        with open_store(path) as store:
            head = store.head()
            for number in range(1, head + 1):
                try:
                    content[number] = plain(store.load(number)), plain(store.changes(number))
                    content[-number] = plain(store.evidence(revisions=[number]))
                    content["attached", number] = [store.attached(item) for item in store.attachments([number])]
                except EvermapError as error:
                    told = told or error
            content["log"] = plain(store.log()), store.lineage(), plain(store.evidence()), plain(store.changes_of(1))
    except EvermapError as error:
        told = told or error
    if told is None:
        return content
    if isinstance(told, DamagedMapError) and told.intact:
        found = verify_store(path)
        if found.sound or not set(found.intact) <= set(told.intact):
            raise AssertionError(f"verify says {found}, reading says {told}")
        if found.intact:
            number, _ = revert_store(path, found.intact[-1])
            if not verify_store(path).sound:
                raise AssertionError(f"not sound after going back: {verify_store(path)}")
            with open_store(path) as store:
                for k in found.intact:
                    if k in content and content[k] != (plain(store.load(k)), plain(store.changes(k))):
                        raise AssertionError(f"revision {k} is another after going back")
                store.load(number)
    raise told


def _maps(folder: Path) -> tuple[bytes, ...]:
    """A small map with three sessions, an edit, an attachment and a revert."""
    sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "maps"))
    from random_maps import random_changes, random_evidence, random_map  # type: ignore[import-not-found, unused-ignore]

    from evermap.maps.store import Provenance, open_store

    path = folder / "fuzz.evermap"
    path.unlink(missing_ok=True)
    with open_store(path, create=True) as store:
        for k in range(3):
            living = random_map(k, cliques=3)
            about = Provenance(recording=f"session {k}", config="[slam]\nseed = 1\n")
            told = random_changes(k, living), random_evidence(k, living, looks=5)
            store.commit(living, about, *told, parent=k, attachments={"session": bytes(range(200))})
        name = int(living.members.landmark_id[0])
        store.commit(living.edited(name, pinned=True), Provenance(note="an edit"), parent=3)
        store.revert(2)
    return (path.read_bytes(),)


def kinds(folder: Path) -> dict[str, Callable[[], Kind]]:
    """Every kind of file, made when it is asked for."""
    return {
        "maps": lambda: Kind(".evermap", _maps(folder), edit_map, read_map, checked=True),
        "old-maps": lambda: Kind(".evermap", (_old_map(),), edit_map, read_map),
        "models": lambda: Kind(".json", _models(folder), edit_json, _read_model(folder)),
        "config": lambda: Kind(".toml", _configs(), edit_text, _read_config),
        "looks-csv": lambda: Kind(".csv", (_looks(folder),), edit_text, _read_looks),
        "looks-parquet": lambda: Kind(".parquet", (_parquet(_looks(folder)),), edit_parquet, _read_looks),
        "detections-csv": lambda: Kind(".csv", (_detections(folder),), edit_text, _read_detections),
        "detections-parquet": lambda: Kind(
            ".parquet", (_parquet(_detections(folder)),), edit_parquet, _read_detections
        ),
        "lifetimes-csv": lambda: Kind(".csv", (_LIFETIMES,), edit_text, _read_lifetimes),
        "lifetimes-parquet": lambda: Kind(".parquet", (_parquet(_LIFETIMES),), edit_parquet, _read_lifetimes),
        "landmarks-csv": lambda: Kind(".csv", (_landmarks(folder, ".csv"),), edit_text, _read_landmarks),
        "landmarks-parquet": lambda: Kind(".parquet", (_landmarks(folder, ".parquet"),), edit_parquet, _read_landmarks),
        "landmarks-geojson": lambda: Kind(".geojson", (_landmarks(folder, ".geojson"),), edit_json, _read_landmarks),
        "recording-zip": lambda: Kind(".zip", (_recording(folder),), edit_zip, _read_recording),
        "bags-ros1": lambda: Kind(".bag", _bags(folder, "{}.bag"), edit_bag, _read_bag),
        "bags-mcap": lambda: Kind(".mcap", _bags(folder, "{}"), edit_bag, _read_bag),
        "bags-sqlite": lambda: Kind(".db3", _bags(folder, "{}_sqlite"), edit_bag, _read_bag),
        "pose-graphs": lambda: Kind(".g2o", _GRAPHS, edit_text, _read_recording),
        "no-recordings": lambda: Kind("", _OTHERS, flip, _read_other),
        "recording-csv": lambda: Kind(".csv", (_seen_rows(),), edit_text, _read_rows),
        "tum": lambda: Kind(".tum", (_TUM,), edit_text, _read_tum),
        "priors": lambda: Kind(".txt", _PRIORS, edit_text, _read_prior),
    }  # fmt: skip


_LIFETIMES = (
    b"left,right,class_id,x_m,y_m\n10,20,car,1,1\n30,,car,1,1\n5,5,car,12,1\n50,60,pallet,1,1\n70,,pallet,1,1\n"
)
_GRAPHS = (
    (
        b"VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 1 0 0.1\nVERTEX_XY 7 1 1\nEDGE_SE2 0 1 1.0 0.0 0.1 500 0 0 500 0 5000\n"
        b"EDGE_SE2 1 2 1.0 0 0 500 0 0 500 0 5000\nEDGE_SE2 0 2 2.0 0.1 0.1 500 0 0 500 0 5000\n"
        b"EDGE_SE2_XY 0 7 1.0 1.0 100 0 100\nEDGE_SE2_XY 2 7 -1.0 1.0 100 0 100\nEDGE_RANGE_SE2_XY 1 8 3.0 100\n"
    ),
    (
        b"VERTEX_SE2 0.0 A0 0 0 0\nVERTEX_SE2 1.0 A1 1 0 0\nVERTEX_SE2 0.5 B0 1 0 0\nVERTEX_XY L3 1 1\n"
        b"EDGE_SE2 1.0 A0 A1 1 0 0 .01 0 0 .01 0 .01\nEDGE_RANGE 1.0 A1 L3 1.0 0.01\nEDGE_RANGE 0.0 A0 L3 1.4 0.01\n"
    ),
    b"PARAMS_SE3OFFSET 0 0 0 1 0 0 0 1\nVERTEX_SE3:QUAT 0 0 0 0 0 0 0 1\n"
    b"EDGE_SE3:QUAT 0 1 1 0 0 0 0 0 1 " + b" ".join([b"100"] * 21) + b"\n"
    b"EDGE_SE3:QUAT 8070450532247928832 7782220156096217095 1 0 0 0 0 0 1\n"
    b"EDGE_SE3_TRACKXYZ 0 50 0 1 2 3 100 0 0 100 0 100\nEDGE_SE3_TRACKXYZ 1 50 0 0 2 3 100 0 0 100 0 100\n",
)
_OTHERS = (
    b"1.5 1 2 0 0 0 0 1\n2.5 1 2 0 0 0 0 1\n", b"1 0 0 0 0 1 0 0 0 0 1 0\n", b"#timestamp [ns],x\n1,2\n",
    b"MATLAB 5.0 MAT-file, Platform: GLNXA64", b"version https://git-lfs.github.com/spec/v1\noid sha256:4d\nsize 12\n",
    b"\x89PNG\r\n\x1a\n" + bytes(40), b"SQLite format 3\0" + bytes(84), b"\x1f\x8b\x08" + bytes(30), b"{}", b"PK\3\4",
)  # fmt: skip


def _read_other(path: Path) -> str:
    """What a file that is no recording is said to be; to read it, or not to fail, would be the defect."""
    from evermap.io import read_recording

    try:
        read_recording(path)
    except EvermapError as error:
        line = error.one_line()
        assert printable(line) == line, line
        return ""
    return "a recording"


def _seen_rows() -> bytes:
    rows = "".join(f"{0.1 * k:.1f},{k % 3},{2.0 + 0.01 * k:.2f},{0.1 * (k % 5):.1f}\n" for k in range(60))
    return ("stamp_s,landmark_id,range_m,bearing_rad\n" + rows).encode()


def _read_rows(path: Path) -> Any:
    """A table of detections, beside odometry."""
    from evermap.io import read_recording

    folder = path.with_suffix(".drive")
    folder.mkdir(exist_ok=True)
    odometry = "".join(f"{0.1 * k:.1f},1.0,0.1\n" for k in range(60))
    (folder / "odometry.csv").write_text("stamp_s,forward_mps,angular_radps\n" + odometry)
    (folder / "detections.csv").write_bytes(path.read_bytes())
    found = plain(replace(read_recording(folder), source=""))
    shutil.rmtree(folder)
    return found


_TUM = b"# t x y z qx qy qz qw\n1.0 2 3 0 0 0 0 1\n2.5 3 4 0 0 0 1 0\n"
_PRIORS = (
    b"exponential:half-life=30d", b"0.9*exponential:half-life=12h+0.1*never-leaves", b"weibull:scale=3d,shape=0.7",
    b"uniform:limit=3d", b"gamma:shape=2,scale=1h",
)  # fmt: skip


def _old_map() -> bytes:
    return (Path(__file__).parents[1] / "tests" / "maps" / "data" / "schema_2.evermap").read_bytes()


def _example(folder: Path, verb: str, name: str) -> bytes:
    from typer.testing import CliRunner

    from evermap.cli.main import app

    path = folder / name
    if not path.is_file():
        result = CliRunner().invoke(app, ["init", {"persist": "looks", "track": "detections"}[verb], str(path)])
        assert result.exit_code == 0, result.output
    lines = [line for line in path.read_text().splitlines() if not line.startswith("#")]
    return ("\n".join(lines[:40]) + "\n").encode()


def _looks(folder: Path) -> bytes:
    return _example(folder, "persist", "looks.csv")


def _detections(folder: Path) -> bytes:
    return _example(folder, "track", "detections.csv")


def _parquet(table: bytes) -> bytes:
    import pyarrow as pa
    import pyarrow.parquet as pq
    from pyarrow import csv

    sink = io.BytesIO()
    pq.write_table(csv.read_csv(pa.BufferReader(table)), sink)
    return sink.getvalue()


def _landmarks(folder: Path, suffix: str) -> bytes:
    from evermap.io import write_map_geojson, write_map_parquet
    from evermap.io.landmarks import write_map_csv
    from evermap.types import Landmarks

    count = 5
    random_ = np.random.default_rng(0)
    landmarks = Landmarks(
        landmark_id=np.arange(count),
        position_m=random_.normal(size=(count, 2)),
        covariance_m2=np.tile(np.eye(2) * 0.01, (count, 1, 1)),
        class_id=np.arange(count) % 2,
        p_exists=np.full(count, 0.9),
        n_hits=np.full(count, 4),
        n_misses=np.full(count, 1),
        first_seen_s=np.zeros(count),
        last_seen_s=np.full(count, 9.0),
        class_names=("pallet", "cart"),
        frame="prior_map",
    )
    writers: dict[str, Any] = {".csv": write_map_csv, ".parquet": write_map_parquet, ".geojson": write_map_geojson}
    path = folder / f"landmarks{suffix}"
    writers[suffix](landmarks, path)
    return path.read_bytes()


def _recording(folder: Path) -> bytes:
    from evermap.io import write_template

    where = folder / "template"
    if not where.is_dir():
        write_template(where)
    sink = io.BytesIO()
    with zipfile.ZipFile(sink, "w") as archive:
        for path in sorted(where.iterdir()):
            archive.writestr(path.name, b"\n".join(path.read_bytes().split(b"\n")[:60]) + b"\n")
    return sink.getvalue()


UNSTATED = ("aruco", "scene", "fiducials", "apriltag_ros", "aruco_ros", "alvar", "cartographer")
"""Detectors whose types of messages an sqlite bag doesn't define."""


def _bags(folder: Path, name: str) -> tuple[bytes, ...]:
    """A drive past two tags with every kind of detector."""
    sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "io"))
    from bags import DETECTORS, write  # type: ignore[import-not-found, unused-ignore]

    found = []
    for detector in DETECTORS:
        unstated = detector in UNSTATED and name.endswith("_sqlite")
        if unstated or (detector == "markers" and name.endswith(".bag")):  # of types that such a bag does not hold
            continue
        path = write(folder / name.format(detector), detector)
        file = path if path.is_file() else next(one for one in path.iterdir() if one.suffix in (".mcap", ".db3"))
        found.append(file.read_bytes())
    return tuple(found)


def _models(folder: Path) -> tuple[bytes, ...]:
    from evermap.existence.one_stay import OneStay
    from evermap.existence.phase_type import PhaseType
    from evermap.existence.run_length import RunLength
    from evermap.runs.persist.table import read_looks
    from evermap.survival import Exponential, Mixture, Weibull

    models = [
        OneStay.of_text("exponential:half-life=12h"),
        PhaseType.two_state(1e-4, 2e-4),
        PhaseType.from_mixtures(Mixture((Exponential(1e-4), Exponential(1e-6)), (0.5, 0.5)), Exponential(1e-5)),
        RunLength(Weibull(1e5, 0.7), Exponential(1e-5), 600.0),
    ]
    single = [{"schema_version": 1, **model.to_dict()} for model in models]
    table = folder / "looks-for-models.csv"
    table.write_bytes(_looks(folder))
    named = {name: single[k % 4] for k, name in enumerate((*read_looks(table).class_names, ""))}
    several = {"schema_version": 1, "kind": "several", "per": "class", "models": named}
    return tuple(json.dumps(content).encode() for content in (*single, several))


def _read_model(folder: Path) -> Callable[[Path], Any]:
    from evermap.existence.protocol import Instants
    from evermap.runs.persist.models import load_models
    from evermap.runs.persist.table import read_looks

    table = folder / "looks-for-models.csv"
    table.write_bytes(_looks(folder))
    features = read_looks(table)
    looks = features.looks(features.order())
    asked = Instants.same_for_all(looks.n_features, np.linspace(looks.stamp_s.min(), looks.stamp_s.max() + 1e5, 3))

    def read(path: Path) -> Any:
        models = load_models(path, features)
        with np.errstate(all="ignore"):
            return plain(models.track(looks, asked).p_present)

    return read


def _configs() -> tuple[bytes, ...]:
    from evermap.config import Config, to_toml

    return (
        to_toml(Config()).encode(),
        b'[slam]\nseed = 3\nmethod = "joint"\n[slam.modes]\nmcts_budget = 4\n[sensor]\nrange_max_m = 12.0\n',
    )


def _read_config(path: Path) -> Any:
    from evermap.config import load_config, to_toml, with_overrides

    config = load_config(path)
    text = path.read_text(encoding="utf-8", errors="replace")
    with contextlib.suppress(EvermapError):
        with_overrides(config, [line for line in text.splitlines()[:3] if "=" in line] + [f"slam.seed={text[:50]}"])
    return to_toml(config)


def _read_looks(path: Path) -> Any:
    from evermap.runs.persist.table import read_looks

    return plain(read_looks(path))


def _read_detections(path: Path) -> Any:
    from evermap.tracking.detections import read_detections

    return plain(read_detections(path))


def _read_lifetimes(path: Path) -> Any:
    from evermap.runs.track.lifetimes import groups_of, read_lifetimes

    table = read_lifetimes(path)
    return plain(table), len(groups_of(table, ("class",), 10.0))


def _read_landmarks(path: Path) -> Any:
    from evermap.io import read_landmarks

    return plain(read_landmarks(path))


def _read_recording(path: Path) -> Any:
    from evermap.io import read_recording

    return plain(read_recording(path))


def _read_bag(path: Path) -> Any:
    from evermap import check_recording
    from evermap.io import read_recording
    from evermap.io.bag import bag_settings, settings_path

    beside = settings_path(path)
    beside.unlink(missing_ok=True)
    text = bag_settings(path)
    if "AprilTagDetectionArray" in text:
        beside.write_text(text + "[tags]\nsize_m = 0.2\n", encoding="utf-8")
    recording = replace(read_recording(path), name="", source="")
    with np.errstate(all="ignore"):
        return text, plain(recording), plain(check_recording(recording))


def _read_tum(path: Path) -> Any:
    from evermap.io import read_tum

    return plain(read_tum(path))


def _read_prior(path: Path) -> Any:
    from evermap.survival import parse_prior

    return plain(parse_prior(path.read_text(encoding="utf-8", errors="replace")))


def main() -> int:
    """Run what was asked for; the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kind", nargs="*", help="kinds of files, or how their names begin; all if none is named")
    parser.add_argument("--files", type=int, default=1500, help="mutated files of each kind")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--verbose", action="store_true", help="show every defect")
    asked = parser.parse_args()
    defects = 0
    columns = ("same", "other", "line", "silent", "traceback", "long line")
    print(f"{'kind':<20} {'files':>6} " + " ".join(f"{name:>9}" for name in columns))
    with tempfile.TemporaryDirectory() as where:
        folder = Path(where)
        made = kinds(folder)
        chosen = [name for name in made if name.startswith(tuple(asked.kind) or "")]
        if not chosen:
            parser.error(f"no such kind: {', '.join(asked.kind)}; there are {', '.join(made)}")
        for name in chosen:
            (folder / name).mkdir()
            counts = run(made[name](), asked.files, asked.seed, folder / name, verbose=asked.verbose)
            print(f"{name:<20} {asked.files:>6} " + " ".join(f"{counts[column]:>9}" for column in columns), flush=True)
            defects += sum(counts[column] for column in columns[3:])
    return int(defects > 0)


if __name__ == "__main__":
    sys.exit(main())
