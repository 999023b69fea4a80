"""How often a detector takes one class for another, from a table."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from evermap.errors import InputError
from evermap.io.columns import read_columns
from evermap.io.text import quote
from evermap.types import UNKNOWN, FloatArray
from evermap.valid import Quantity


def read_confusion(path: str | Path, class_names: Sequence[str]) -> FloatArray:
    """A table with a row a true class: its name in `class_id`, and a column for each class that it is detected as.

    Args:
        path: a `.csv`, `.csv.gz` or `.parquet` file.
        class_names: the C classes of the detections.

    Returns:
        (C, C) `P(detected class | true class)`, a row a true class.

    Raises:
        InputError: a class is missing or there twice, or a row is no distribution; by line and column.
    """
    table = read_columns(path, [])
    table.expect(("class_id", *class_names))
    names, of_row = table.labels("class_id")
    columns = [table.numbers(Quantity(name, 0.0, 1.0, hint="a probability")) for name in class_names]
    p_detected = np.stack(columns, axis=1)
    confusion = np.full((len(class_names), len(class_names)), np.nan)
    for row, code in enumerate(of_row.tolist()):
        name = names[code] if code != UNKNOWN else ""
        if name not in class_names:
            hint = f"one of {', '.join(class_names)}"
            raise table.error(f"no detection is of class {quote(name)}", row=row, field="class_id", hint=hint)
        true = class_names.index(name)
        if not np.isnan(confusion[true, 0]):
            raise table.error(f"class {quote(name)} appears twice", row=row, field="class_id", hint="one row a class")
        total = float(p_detected[row].sum())
        if abs(total - 1.0) > 1e-6:
            raise table.error(f"the row sums to {total:g}", row=row, hint="probabilities that sum to 1")
        confusion[true] = p_detected[row]
    missing = np.flatnonzero(np.isnan(confusion[:, 0]))
    if missing.size:
        problem = f"has no row for class {quote(class_names[missing[0]])}"
        raise InputError(problem, path=path, field="class_id", hint="one row a class")
    return confusion
