# SPDX-License-Identifier: Apache-2.0
"""Convert a table to a recording: `import run.csv my_bag --time t:ms --theta angle:deg --duty pwm:%`.

Without options for the columns, the command shows the table and proposes options, by names, units and numbers. --accept
uses the proposal if it is sure.
Exit code 0: a recording is written; 2: the table cannot be used, with one line on standard error.
"""

from __future__ import annotations

import argparse
import shlex
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table as Shown

from aeropend_ident.bags.reading import RecordingError
from aeropend_ident.tables import bag as of_bag
from aeropend_ident.tables import files
from aeropend_ident.tables.clock import CLOCKS
from aeropend_ident.tables.guess import Given, Guess, guess, is_obvious, option, options
from aeropend_ident.tables.join import join
from aeropend_ident.tables.mapping import Plan, Samples, no_time, samples
from aeropend_ident.tables.sparkline import sparkline
from aeropend_ident.tables.table import Table, TableError
from aeropend_ident.tables.units import UNITS, listed
from aeropend_ident.tables.write import BagExistsError, write
from aeropend_sim.cli.command import EXIT_CODES, Parser, between, called, entry_point, own
from aeropend_sim.cli.progress import progress
from aeropend_sim.untrusted import one_line, printable
from aeropend_sim.wording import counted

DELIMITERS = {"tab": "\t", "blank": " ", "blanks": " ", "space": " ", "\\t": "\t"}

EXAMPLES = f"""\
examples:
  import run.csv                                      show the columns and propose options
  import run.csv my_bag --accept                      use the proposed options
  import run.csv my_bag --time "t [ms]:ms" --theta angle:deg --duty pwm:counts:255
  import fall.csv my_bag --time 1:s --theta 2:deg --zero end --motor-off
  import day1.xlsx day2.xlsx bags --sheet Data --time 1:s --theta 2:deg --duty 3:%
  import adc.npy my_bag --rate 490 --theta 1:counts:1024 --zero 512 --flip
  import rig.csv my_bag --time t:s --theta y:rad --duty u:V --supply 12V --both-ways reverse
  import angle.csv my_bag --with voltage.csv --accept --supply 12V
  import my_bag mended --theta theta:deg --flip       a recording whose angle is in degrees, with the wrong sign
  import my_bag mended --current v_a:A --voltage i_a:V                     one with two columns in the wrong place

COLUMN is the name of a column in the file, or its number, from 1. A unit may have a factor: `--theta pot:54deg` if one
volt is 54 degrees, `--current adc:-4.9mA`. With several files, each becomes a recording in the folder given last.

{EXIT_CODES}"""


def parse(arguments: Sequence[str]) -> argparse.Namespace:
    """Read the command line; exits with code 2 and one line if it is wrong."""
    parser = Parser(
        prog="import", usage="import FILE [FILE ...] BAG [--time COLUMN:UNIT] [--theta COLUMN:UNIT] [options]",
        epilog=EXAMPLES, formatter_class=argparse.RawDescriptionHelpFormatter,
        description="Convert a table to a recording: CSV, TSV, text, Excel (.xlsx), MATLAB (.mat), NumPy (.npy, .npz). "
                    "A recording\nis converted too, to change the unit, sign, zero or place of a channel: t, theta, "
                    "omega, i_a, v_a, duty, reference.\nTime stamps that are late, rounded, repeated or wrapped are "
                    "repaired; the repairs are listed.")
    parser.add_argument("paths", nargs="+", metavar="FILE",
                        help="the table, then the recording to write (BAG); for several tables, a folder of recordings")
    columns = parser.add_argument_group("meaning of the columns (COLUMN or COLUMN:UNIT)")
    about = {"time": "time of the row", "theta": "angle of the arm", "duty": "applied duty",
             "omega": "speed of the rotor", "current": "current of the motor", "voltage": "voltage at the motor",
             "reference": "reference of the arm's angle or the rotor's speed"}
    for quantity in UNITS:
        columns.add_argument(f"--{quantity}", metavar="COLUMN:UNIT",
                             help=f"{about[quantity]}: {listed(quantity)}".replace("%", "%%"))
    columns.add_argument("--accept", action="store_true", help="use the proposed options for the columns")
    more = parser.add_argument_group("information that is not in the table")
    more.add_argument("--rate", type=between(0.1, 1e6, "a rate", "Hz"), metavar="HZ",
                      help="the rows are evenly spaced, at this rate")
    more.add_argument("--zero", metavar="READING",
                      help="reading of --theta when the arm hangs: -83deg, or a number in its unit; `start` or `end` "
                           "if it hangs at rest at the start or the end; default 0")
    more.add_argument("--flip", action="store_true", help="--theta decreases when the arm is lifted")
    more.add_argument("--motor-off", action="store_true", help="the duty was always 0, as in a free swing")
    more.add_argument("--supply", metavar="VOLTAGE",
                      help="voltage of the supply, as in 12V: full duty, for a command in volts (--duty COLUMN:V)")
    more.add_argument("--both-ways", choices=("reverse", "brake", "clip"), default="",
                      help="what a command below 0 does: reverse the motor; brake it, or nothing (clip): both count "
                           "as 0; without it such a command is refused")
    more.add_argument("--with", action="append", default=[], metavar="FILE", dest="others",
                      help="another file of the same experiment, joined by its time: each row takes the last value "
                           "before it; may be repeated")
    more.add_argument("--clock", choices=CLOCKS, default="auto",
                      help="even: the rows are evenly spaced and the stamps are not exact; stamps: every stamp is "
                           "right; auto: choose by the data and report why")
    more.add_argument("--namespace", metavar="NS", help="namespace of the rig, if FILE is a recording of several")
    more.add_argument("--sheet", metavar="NAME", help="sheet of a workbook with several tables")
    more.add_argument("--delimiter", type=_delimiter, metavar="MARK", help="between cells: , ; tab blank or another")
    more.add_argument("--decimal", choices=(".", ","), metavar="MARK", help="decimal mark: . or ,")
    more.add_argument("--overwrite", action="store_true", help="replace the recording, if it is there already")
    more.add_argument("--skip-bad", action="store_true", help="skip rows that cannot be read")
    given = parser.parse_args(_joined(arguments))
    given.files, given.bag = [Path(path) for path in given.paths], None
    if len(given.paths) > 1:
        *given.files, given.bag = given.files
        if given.bag.is_file():
            parser.error(f"{given.bag} is a file: name the recording to make last")
        stems = [file.stem for file in given.files]
        same = next((stem for stem in stems if stems.count(stem) > 1), None)
        if same:
            parser.error(f"two files are called {same}: import them one by one")
    if given.motor_off and given.duty:
        parser.error("--motor-off and --duty contradict each other")
    if given.rate is not None and given.time:
        parser.error("--rate and --time contradict each other: give one")
    if given.rate is not None and given.clock != "auto":
        parser.error("--clock applies to stamps: omit it with --rate")
    if given.others and len(given.files) > 1:
        parser.error("--with belongs to one file: import the others one by one")
    return given


def _joined(arguments: Sequence[str]) -> list[str]:
    """`--zero -83deg` as `--zero=-83deg`: argparse takes -83deg for an option."""
    out: list[str] = []
    for word in arguments:
        if out and out[-1] == "--zero" and not word.startswith("--"):
            out[-1] = f"--zero={word}"
        else:
            out.append(word)
    return out


def _delimiter(text: str) -> str:
    mark = DELIMITERS.get(text, text)
    if len(mark) != 1 or mark.isalnum() or mark in "\"'+-.\n\r":
        raise argparse.ArgumentTypeError(f"'{text}' cannot split cells: give one mark, tab or blank")
    return mark


def plan_of(given: argparse.Namespace) -> Plan:
    """The options of the command line as a plan for the columns."""
    return Plan(**{quantity: getattr(given, quantity) for quantity in UNITS}, rate=given.rate, zero=given.zero,
                flip=given.flip, motor_off=given.motor_off, clock=given.clock, skip_bad=given.skip_bad,
                supply=given.supply, both_ways=given.both_ways)


def run(given: argparse.Namespace, arguments: Sequence[str]) -> int:
    """Import the tables, or propose options; returns the exit code.

    Args:
        given: the parsed command line.
        arguments: the command line, for messages and metadata.

    Raises:
        TableError: a table cannot be used, or a recording cannot be written.
        BagExistsError: a recording exists already.
    """
    plan = plan_of(given)
    if given.bag is None and (given.accept or plan.columns()):
        raise TableError("name the recording to make, after the file")
    bags = [given.bag] if len(given.files) == 1 else [given.bag / file.stem for file in given.files]
    for bag in bags:
        if bag is not None and bag.exists() and not (given.overwrite and (bag / "metadata.yaml").is_file()):
            what = "is no recording, and is not replaced" if given.overwrite else "is there already"
            raise BagExistsError(f"{bag}: {what}: name another folder" + ", or add --overwrite" * (not given.overwrite))
    for done, (file, bag) in enumerate(zip(given.files, bags)):
        try:
            with progress(f"reading {printable(file.name)}") as show:
                table = _read(file, given)
                now, unsure, said = plan, "", plan.columns()
                if of_bag.is_recording(file):
                    if bag is None or not (said or plan.flip or plan.zero or plan.motor_off):
                        raise TableError(f"{file}: is a recording already: name what to change, and the recording to "
                                         f"make, as in {called('import', 'aeropend_ident')} {shlex.quote(str(file))} "
                                         "NEW --theta theta:deg")
                    now = replace(plan, **cast("dict[str, Any]", of_bag.options(table, said)),
                                  clock="stamps" if plan.clock == "auto" else plan.clock)
                elif given.accept or not said:
                    found = [Guess(why="as you say") if one.quantity in said else one
                             for one in guess(table, Given(plan.supply is not None, bool(plan.both_ways)))]
                    chosen = {**options(table, found), **said}
                    if plan.rate is not None:
                        chosen.pop("time", None)
                    if not given.accept or not _enough(chosen, found, plan):
                        return propose(table, found, chosen, given, arguments)
                    unsure = "".join(f"  perhaps --{one.quantity} {shlex.quote(option(table, k, one))} ({one.why})\n"
                                     for k, one in enumerate(found) if one.quantity and not one.sure)
                    now = replace(plan, **cast("dict[str, Any]", chosen))
                taken = samples(table, now)
                assert bag is not None
                show(0.0, f"writing {printable(bag.name)}")
                with _put_aside(bag):
                    write(bag, taken, about(file, arguments, taken), show)
        except (TableError, BagExistsError, RecordingError) as error:
            ready = f" ({counted(done, 'recording')} before it {'is' if done == 1 else 'are'} made)" if done else ""
            raise TableError(f"{error}{ready}") from None
        except OSError as error:
            raise TableError(f"{bag}: cannot be written: {error.strerror or error}") from None
        tell(bag, file, taken)
        print(printable(unsure.rstrip()), end="\n" if unsure else "")
    return 0


@contextmanager
def _put_aside(bag: Path) -> Iterator[None]:
    """A recording that is replaced stays until the new one is written, and comes back if that fails."""
    if not bag.exists():
        yield
        return
    with tempfile.TemporaryDirectory(dir=bag.parent, prefix=f".{bag.name}") as folder:
        old = Path(folder) / bag.name
        bag.rename(old)
        try:
            yield
        except BaseException:
            old.rename(bag)
            raise


def _read(file: Path, given: argparse.Namespace) -> Table:
    """The table of a file, and of those that belong to it."""
    if of_bag.is_recording(file):
        return of_bag.read(file, given.namespace)
    first, *others = [files.read(path, sheet=given.sheet, delimiter=given.delimiter, decimal=given.decimal)
                      for path in (file, *map(Path, given.others))]
    return join([first, *others]) if others else first


def _enough(chosen: dict[str, str], found: Sequence[Guess], plan: Plan) -> bool:
    if plan.rate is not None:
        chosen = {**chosen, "time": ""}
        found = [one for one in found if one.quantity != "time"]
    if plan.motor_off and "duty" in chosen:
        return False
    return is_obvious(chosen, list(found))


def about(file: Path, arguments: Sequence[str], taken: Samples) -> dict[str, str]:
    """Origin of a recording, for its metadata; without folders of this machine.

    Args:
        file: the table.
        arguments: the command line.
        taken: the samples.
    """
    words = [Path(word).name if Path(word).name and not word.startswith("-") and Path(word).parent.is_dir()
             and "/" in word else word for word in arguments]
    found = {"imported_from": [file.name], "import_command": [shlex.join(["import", *words])],
             "import_mapping": taken.mapping, "import_notes": taken.notes, "import_left_out": taken.left_out}
    return {key: "\n".join(map(printable, lines)) for key, lines in found.items()}


def tell(bag: Path, file: Path, taken: Samples) -> None:
    """Print the result of an import.

    Args:
        bag: the recording.
        file: the table.
        taken: the samples.
    """
    seconds = float(taken.stamp_ns[-1] - taken.stamp_ns[0]) * 1e-9
    rate = taken.rows / max(seconds, 1e-9)
    lines = [f"{bag}: {counted(taken.rows, 'row')} of {file.name}, {seconds:.1f} s, {rate:.4g} a second"]
    lines += [f"  {line}" for line in taken.mapping] + [f"  note: {line}" for line in taken.notes]
    if taken.left_out:
        lines.append(f"  left out: column{'s' * (len(taken.left_out) > 1)} {', '.join(taken.left_out)}")
    print("\n".join(map(printable, lines)))


def propose(table: Table, found: Sequence[Guess], chosen: dict[str, str], given: argparse.Namespace,
            arguments: Sequence[str]) -> int:
    """Show a table and the command that would import it; returns the exit code.

    Args:
        table: the table.
        found: a guess for each column.
        chosen: the proposed options.
        given: the parsed command line.
        arguments: the command line.
    """
    console = Console(highlight=False)
    if not console.is_terminal:
        console = Console(highlight=False, width=10_000)
    shown = Shown(box=box.SIMPLE_HEAD, pad_edge=False)
    encoding = getattr(sys.stdout, "encoding", None)
    for heading in ("column", "first values", "range", "", "looks like"):
        shown.add_column(heading, overflow="fold")
    drawn = table.possible().columns
    for k, (column, one) in enumerate(zip(table.columns, found)):
        x = column.values[np.isfinite(column.values)]
        low_high = f"{x.min():.6g} to {x.max():.6g}" if len(x) and not column.is_clock else ""
        what = f"{one.quantity}{'' if one.sure else '?'} ({one.why})" if one.quantity else one.why or "?"
        cells = (table.label(k), "  ".join(column.shown), low_high, sparkline(drawn[k].values, encoding), what)
        shown.add_row(*(escape(printable(cell)) for cell in cells))
    print(printable(f"{table.path}: {counted(len(table), 'row')}"))
    for note in table.notes:
        print(f"  {printable(note)}")
    console.print(shown)
    timeless = given.rate is None and not any(one.quantity == "time" for one in found)
    if timeless and not any(one.quantity == "theta" for one in found):
        print(f"import: {one_line(no_time(table))}", file=sys.stderr)
        return 2
    bag = given.bag or Path(table.path.stem)
    kept = _kept(arguments, given)
    open_ = {one.quantity: option(table, k, one) for k, one in enumerate(found)
             if one.quantity in ("time", "theta", "duty") and not one.sure}
    if given.rate is not None:
        open_.pop("time", None)
    all_ = {**chosen, **open_}
    words = [str(table.path), str(bag)]
    for quantity in UNITS:
        if quantity in all_:
            words += [f"--{quantity}", all_[quantity]]
    missing = ["--rate HZ"] * timeless + ["--theta COLUMN:UNIT"] * ("theta" not in all_)
    print("\n  " + printable(" ".join([called("import", "aeropend_ident"), shlex.join(words + kept), *missing])))
    for k, one in enumerate(found):
        if one.quantity and not one.sure and not (one.quantity == "time" and given.rate is not None):
            check = "check" if one.quantity in open_ else "perhaps"
            print(printable(f"  {check} --{one.quantity} {shlex.quote(option(table, k, one))} ({one.why})"))
    off = "." if all_.keys() & {"duty", "voltage"} or given.motor_off else ",\n--motor-off if the motor was always off."
    print("\nAdd --zero READING if --theta is not 0 when the arm hangs, --flip if it decreases when the arm is "
          f"lifted{off}")
    if timeless:
        print(f"import: {one_line(no_time(table))}", file=sys.stderr)
    elif _enough(chosen, found, plan_of(given)):
        print("import: nothing imported yet: give the options of the columns as above, or use them with --accept",
              file=sys.stderr)
    else:
        print("import: nothing imported: give the options of the columns as above, but check first what is not clear",
              file=sys.stderr)
    return 2


def _kept(arguments: Sequence[str], given: argparse.Namespace) -> list[str]:
    """The words of the command line that stay in the proposed one."""
    paths, columns = list(given.paths), [f"--{quantity}" for quantity in UNITS]
    kept: list[str] = []
    for before, word in zip(["", *arguments], arguments, strict=False):
        if word in paths and before != "--with":
            paths.remove(word)
        elif word != "--accept" and word.partition("=")[0] not in columns and before not in columns:
            kept.append(word)
    return kept


@entry_point("import")
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit code."""
    arguments = own(arguments)
    given = parse(arguments)
    return run(given, arguments)


if __name__ == "__main__":
    sys.exit(main())
