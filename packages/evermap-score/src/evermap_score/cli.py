"""`evermap-score TRUTH ESTIMATE ...`: the command."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from evermap_score.errors import ScoreError

EXIT_USER = 2
EPILOG = """\
A table of episodes is CSV or Parquet; see the README. Also read: a folder of a run of evermap, its map, Khronos'
object_changes.csv, two surveys of any format as BEFORE,AFTER (field layouts of WPILib, tagslam.yaml, id,x,y,z), label
files of KITTI tracking, 3RScan.json. A trajectory is read from NAME.tum beside NAME.csv.

Examples:
  {program} truth.csv out/monday
  {program} truth.csv ours.csv theirs.csv --looks looks.csv --markdown"""


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> None:  # type: ignore[override]
        raise ScoreError(message, hint=f"{self.prog} --help")


def _make_parser(program: str) -> argparse.ArgumentParser:
    form = argparse.RawDescriptionHelpFormatter
    epilog = EPILOG.format(program=program)
    parser = _Parser(prog=program, description="Score maps that change.", epilog=epilog, formatter_class=form)
    parser.add_argument("truth", metavar="TRUTH", help="episodes that are true")
    parser.add_argument("estimates", metavar="ESTIMATE", nargs="+", help="episodes to score; others minus the first")
    parser.add_argument("--looks", metavar="FILE", help="table stamp_s, landmark_id[, session_id] of opportunities")
    parser.add_argument("--match", choices=("identity", "place"), help="default: by identity if ids are shared")
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.add_argument("--markdown", action="store_true", help="print a table of Markdown")
    parser.add_argument("--latex", action="store_true", help="print a tabular of LaTeX")
    parser.add_argument("--figures", metavar="FOLDER", help="write figures, PDF and PNG, into a folder")
    parser.add_argument("--draws", type=int, default=500, help="of the bootstrap (default: 500)")
    parser.add_argument("--seed", type=int, default=0, help="of the bootstrap (default: 0)")
    return parser


def main(arguments: Sequence[str], program: str = "evermap-score") -> None:
    """Score and print.

    Args:
        arguments: of the command line, without the program.
        program: what the user typed, for the help.

    Raises:
        ScoreError: the command line is wrong, or something cannot be read.
    """
    options = _make_parser(program).parse_args(list(arguments))
    if options.json + options.markdown + options.latex > 1:
        raise ScoreError("--json, --markdown and --latex exclude each other")
    if options.draws < 0 or options.seed < 0:
        raise ScoreError("--draws and --seed must not be negative")
    from evermap_score import report
    from evermap_score.score import score

    found = score(
        options.truth,
        dict(zip(_names(options.estimates), options.estimates, strict=True)),
        looks=options.looks,
        match=options.match,
        draws=options.draws,
        seed=options.seed,
    )
    to_output = (
        report.to_json if options.json else report.to_markdown if options.markdown
        else report.to_latex if options.latex else report.to_text
    )  # fmt: skip
    sys.stdout.write(to_output(found))
    if options.figures:
        from evermap_score.figures import write_figures

        for path in write_figures(found, options.figures):
            sys.stderr.write(f"evermap-score: wrote {path}\n")


def _names(paths: Sequence[str]) -> list[str]:
    """Return a name for each path: its last part without ending, or the whole where that is not unique."""
    short = [Path(path).stem for path in paths]
    names = [path if short.count(name) > 1 else name for path, name in zip(paths, short, strict=True)]
    if len(set(names)) < len(names):
        raise ScoreError("an estimate is given twice")
    return names


def run() -> None:
    """Run the command; an error of the user is one line, and the exit code 2."""
    try:
        main(sys.argv[1:])
    except ScoreError as error:
        sys.stderr.write(f"evermap-score: error: {error}\n")
        sys.exit(EXIT_USER)
