"""Long tables: the fast road gives what the careful one gives, and both name what is wrong."""

from __future__ import annotations

import csv
import gzip
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from evermap.errors import InputError
from evermap.io import read_landmarks
from evermap.io.columns import Columns, csv_bytes, named, read_columns
from evermap.io.landmarks import write_map_csv
from evermap.io.table import Table, csv_text, parse_by_line, parse_csv, parse_table
from evermap.types import landmark_id_of
from evermap.valid import Quantity

VALUE = Quantity("value", -1e3, 1e3)
MAYBE = Quantity("value", -1e3, 1e3, optional=True)

PLAIN = "stamp_s,who,value,flag\n1.5, a ,2,1\n0.5,b,-3e2,\n7,a,0.25,TRUE\n7,é,-0.0,false\n"


def read(tmp_path: Path, content: str | bytes, name: str = "t.csv") -> Columns:
    path = tmp_path / name
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return read_columns(path, [])


@pytest.mark.parametrize(
    "content",
    [
        PLAIN,
        PLAIN.rstrip("\n"),
        PLAIN.replace("\n", "\r\n"),
        "\ufeff# a comment\n\n  # another\n" + PLAIN,
        PLAIN.replace("\n", ",\n"),  # a comma at the end of every line
        PLAIN.replace("0.5,b", "# in between\n\n0.5,b"),
        PLAIN.replace(" a ", '" a "'),
    ],
)
@pytest.mark.parametrize("packed", [False, True])
def test_every_way_to_write_a_table_gives_the_same(tmp_path: Path, content: str, packed: bool) -> None:
    data = gzip.compress(content.encode()) if packed else content
    table = read(tmp_path, data, "t.csv.gz" if packed else "t.csv")
    np.testing.assert_array_equal(table.numbers(Quantity("stamp_s")), [1.5, 0.5, 7.0, 7.0])
    np.testing.assert_array_equal(table.numbers(VALUE), [2.0, -300.0, 0.25, 0.0])
    np.testing.assert_array_equal(table.flags("flag", hint=""), [1.0, np.nan, 1.0, 0.0])
    names, who = table.labels("who")
    assert [names[k] for k in who] == ["a", "b", "a", "é"]
    lines = content.replace("\r\n", "\n").split("\n")
    for line, value in zip(table.line, ("2", "-3e2", "0.25", "-0.0"), strict=True):
        assert value in lines[line - 1]


def test_plain_tables_are_read_by_pyarrow(tmp_path: Path) -> None:
    columns = parse_csv(("# comment\n" + PLAIN).encode(), tmp_path / "t.csv", []).columns
    assert all(isinstance(cells, pa.Array) for cells in columns.values())


ODD = [
    PLAIN,
    PLAIN.rstrip("\n"),
    PLAIN.replace("\n", "\r\n"),
    PLAIN.replace("\n", "\r"),
    PLAIN.replace("\n", "\r\r\n"),
    PLAIN.replace("\n", ",\n"),
    PLAIN.replace("0.5,b", "\x0b# between\n\n0.5,b"),
    PLAIN.replace(" a ", '"a ""b"", c"'),
    PLAIN.replace(" a ", '"a\nb"'),
    PLAIN.replace(" a ", "'=a"),
    PLAIN.replace(" a ", 'a"b'),
    PLAIN + "8,c,1",
    PLAIN + "8,c,1\n",
    PLAIN + "8,c,1,1,1\n",
    PLAIN + "8,c,",
    PLAIN.replace("\n", "\n\n", 1),
    "value\n1\n2\n3e",
    "value\n1\n \n2\n",
    "value\n1\n\n2",
    "value\n1\n'2\n",
    "value\n",
    "value",
    "value,value\n1,2\n",
    "value;other\n1;2\n",
    "1,2\n3,4\n",
    "",
]
NUMBERS = ["1_0", "nan(1)", "+1", "0x1", "1e999", "1e-999", "\u0661", "\xa01 ", "Infinity", "-nan", "", " ", "1.", ".5"]


@pytest.mark.parametrize("content", [*ODD, *(f"value,b\n2,x\n{number},x\n3,x\n" for number in NUMBERS)])
def test_a_table_is_the_same_in_one_go_and_line_by_line(tmp_path: Path, content: str) -> None:
    def outcome(parse: Callable[[bytes, Path, list[str]], Table], optional: bool) -> Any:
        warnings: list[str] = []
        try:
            table = parse(content.encode(), tmp_path / "t.csv", warnings)
            labels = {name: [table.labels(name)[1][k] for k in table.labels(name)[0]] for name in table.columns}
            numbers = table.numbers(replace(MAYBE, optional=optional)).tobytes() if "value" in table else b""
        except InputError as error:
            return str(error), warnings
        return table.line.tolist(), labels, numbers, table.header_line, warnings

    for optional in (False, True):
        assert outcome(parse_csv, optional) == outcome(parse_by_line, optional)


@pytest.mark.parametrize("kind", ["csv", "parquet"])
def test_names_are_in_natural_order_and_as_they_were_given(tmp_path: Path, kind: str) -> None:
    given = ["10", "9", "-2", "007", "9"]
    if kind == "csv":
        table = read(tmp_path, "who\n" + "\n".join(given) + "\n")
    else:
        pq.write_table(pa.table({"who": pa.array(given).dictionary_encode()}), tmp_path / "t.parquet")
        table = read_columns(tmp_path / "t.parquet", [])
    names, who = table.labels("who")
    assert names == ["-2", "007", "9", "10"]
    assert [names[k] for k in who] == given


def test_parquet_of_every_type(tmp_path: Path) -> None:
    content = {
        "i": pa.array([2**60 + 1, None, 3], type=pa.int64()),
        "f": pa.array([1.0, None, 2.0]),
        "b": pa.array([True, None, False]),
        "u": pa.array([1, 0, 1], type=pa.uint8()),
        "t": pa.array(["1", None, "2.5"], type=pa.large_string()),
        "n": pa.nulls(3),
    }
    pq.write_table(pa.table(content), tmp_path / "t.parquet")
    table = read_columns(tmp_path / "t.parquet", [])
    assert table.labels("i")[0] == ["3", str(2**60 + 1)]  # not one digit of a large id is lost
    np.testing.assert_array_equal(table.labels("i")[1], [1, -1, 0])
    assert table.labels("f")[0] == ["1", "2"]
    np.testing.assert_array_equal(table.flags("b", hint=""), [1.0, np.nan, 0.0])
    np.testing.assert_array_equal(table.flags("u", hint=""), [1.0, 0.0, 1.0])
    np.testing.assert_array_equal(table.numbers(Quantity("t", optional=True)), [1.0, np.nan, 2.5])
    np.testing.assert_array_equal(table.numbers(Quantity("n", optional=True)), [np.nan] * 3)
    np.testing.assert_array_equal(table.line, [1, 2, 3])


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        ("x", r"t\.csv:3: field 'value': 'x' is not a number"),
        ("", r"t\.csv:3: field 'value': is empty"),
        ("1_0", r"t\.csv:3: field 'value': '1_0' is not a number"),
        ("nan", r"t\.csv:3: field 'value': nan where a finite number is needed"),
        ("inf", r"t\.csv:3: field 'value': inf where a finite number is needed"),
        ("2e3", r"t\.csv:3: field 'value': 2000 is outside \[-1000, 1000\]"),
        ("1,2", r"t\.csv:3: 3 cells instead of 2"),
        ('"1', r"t\.csv:3: quotation marks do not match"),
    ],
)
def test_a_bad_number_is_named_with_its_line(tmp_path: Path, bad: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        read(tmp_path, f"value,b\n1,x\n{bad},x\n3,x\n").numbers(VALUE)


def test_an_empty_cell_may_be_allowed(tmp_path: Path) -> None:
    table = read(tmp_path, "value,b\n1,x\n,x\n nan ,x\n")
    np.testing.assert_array_equal(table.numbers(MAYBE), [1.0, np.nan, np.nan])


def test_bad_flags_names_and_files(tmp_path: Path) -> None:
    table = read(tmp_path, "a,flag\nx\u0007,1\ny,2\n")
    with pytest.raises(InputError, match=r"t\.csv:3: field 'flag': '2' is neither 1 nor 0 \(try: so\)"):
        table.flags("flag", hint="so")
    with pytest.raises(InputError, match=r"t\.csv:2: field 'a': contains a character that cannot be printed"):
        table.labels("a")
    with pytest.raises(InputError, match="no such file"):
        read_columns(tmp_path / "none.csv", [])
    with pytest.raises(InputError, match="is a folder"):
        read_columns(tmp_path, [])
    with pytest.raises(InputError, match="damaged gzip"):
        read(tmp_path, gzip.compress(PLAIN.encode())[:-12], "t.csv.gz")
    with pytest.raises(InputError, match="not a readable Parquet file"):
        read(tmp_path, b"PAR1 and then nonsense", "t.parquet")
    with pytest.raises(InputError, match="is empty"):
        read(tmp_path, "")
    with pytest.raises(InputError, match=r"t\.csv:2: is not plain text"):
        read(tmp_path, b"a\n\xff\n")
    pq.write_table(pa.table({"a": [1.5], "s": [[1]]}), tmp_path / "t.parquet")
    table = read_columns(tmp_path / "t.parquet", [])
    with pytest.raises(InputError, match=r"t\.parquet:1: field 'a': 1\.5 is not a name"):
        table.labels("a")
    with pytest.raises(InputError, match=r"field 's': contains list<.*>, not numbers"):
        table.numbers(Quantity("s"))


def test_an_unfinished_last_line_is_left_out_with_a_remark(tmp_path: Path) -> None:
    (tmp_path / "t.csv").write_text("a,b\n1,2\n3")
    warnings: list[str] = []
    assert len(read_columns(tmp_path / "t.csv", warnings)) == 1
    assert warnings == ["t.csv: 1 unfinished last line (3) left out"]


def test_what_is_written_reads_back_the_same(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    values = np.concatenate([rng.random(50), 1e9 + rng.random(50) * 1e6, [0.0, 1e-300, 1.0, np.nan]])
    index = rng.integers(0, 3, len(values))
    for names in (["1", "2", "3"], ["plain", "com,ma", 'quo"te'], ["#x", "y", " z"]):
        table = read(tmp_path, csv_bytes({"v": values, "who": named(names, index)}))
        np.testing.assert_array_equal(table.numbers(Quantity("v", optional=True)), values)
        found, who = table.labels("who")
        assert [found[k] for k in who] == [names[k].strip() for k in index]
    assert csv_bytes({"v": np.zeros(0)}) == b"v\n"
    assert csv_bytes({"v": np.array([1.0, np.nan]), "who": named(["a"], np.array([0, 0]))}) == b"v,who\n1,a\n,a\n"


def test_tables_are_written_and_read_without_pandas(tmp_path: Path) -> None:
    """What pyarrow converts by itself imports pandas, which takes 0.4 s."""
    code = f"""
import sys
import numpy as np
from evermap.io.columns import csv_bytes, named, read_columns
from evermap.io.arrow import parquet_bytes
from evermap.valid import Quantity

numbers = np.array([1.5, np.nan, 3.0])
path = {str(tmp_path)!r} + "/table"
open(path + ".csv", "wb").write(csv_bytes({{"x": numbers, "name": named(["a", "b, c"], np.array([1, 0, 1]))}}))
open(path + ".parquet", "wb").write(parquet_bytes({{"x": numbers, "name": ["b, c", "", "a"]}}))
for ending, names in ((".csv", ["a", "b, c"]), (".parquet", ["a", "b, c"])):
    table = read_columns(path + ending, [])
    np.testing.assert_array_equal(table.numbers(Quantity("x", optional=True)), numbers)
    assert table.labels("name")[0] == names
print("pandas" in sys.modules)
"""
    done = subprocess.run([sys.executable, "-c", code], check=False, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "False"


FORMULAS = ["=cmd|calc", "=1+2", "+3 kg", "@a", "-a", "'=x", "''-x", '=1,"2"', "=#", "-5 m"]
HARMLESS = ["plain", "-5", "+1e3", "'quoted'", "a=b", "'"]


@pytest.mark.parametrize("comment", ["", "\n# slow\n"])
def test_no_text_is_a_formula_and_all_are_read_back(tmp_path: Path, comment: str) -> None:
    """By both writers and all three readers; a file of another program keeps its quotes."""
    names = [*FORMULAS, *HARMLESS]
    texts = [csv_text({"name": names}), csv_bytes({"name": named(names, np.arange(len(names)))}).decode()]
    for text in texts:
        cells = [row[0] for row in csv.reader(text.splitlines())][1:]
        assert cells == [*(f"'{name}" for name in FORMULAS), *HARMLESS]
        path = tmp_path / "names.csv"
        path.write_text(text + comment)
        of_row, labels = parse_table(path.read_bytes(), path, []).labels("name")
        assert [labels[number] for number in of_row] == names
        found, index = read_columns(path, []).labels("name")
        assert [found[number] for number in index] == names


def test_a_map_is_exported_without_formulas(tmp_path: Path) -> None:
    names = {landmark_id_of(name): name for name in FORMULAS}
    table = "landmark_id,x_m,y_m,class_id\n" + "".join(f"n{k},{k},0,c{k}\n" for k in range(len(FORMULAS)))
    (tmp_path / "plain.csv").write_text(table)
    plain = read_landmarks(tmp_path / "plain.csv")
    hostile = replace(
        plain,
        landmark_id=np.array([*names], dtype=np.int64),
        names=names,
        class_names=tuple(FORMULAS[int(label[1:])] for label in plain.class_names),
    )
    write_map_csv(hostile, tmp_path / "map.csv")
    for row in csv.reader((tmp_path / "map.csv").read_text().splitlines()):
        assert not any(cell.startswith(("=", "+", "@")) for cell in row)
    back = read_landmarks(tmp_path / "map.csv")
    assert {back.names[number] for number in back.landmark_id.tolist()} == {*FORMULAS}
    assert sorted(back.class_names) == sorted(FORMULAS)
