# SPDX-License-Identifier: Apache-2.0
"""A swinging arm in tables of other programs, and their import."""

import numpy as np
import openpyxl

from aeropend_ident.bags.recording import read
from aeropend_ident.commands.import_table import main

RATE = 50.0
TIME = np.arange(200) / RATE
ANGLE = 40.0 * np.exp(-0.1 * TIME) * np.cos(6.0 * TIME)  # deg
DUTY = np.floor(TIME) % 2 * 30.0  # %
PUSH = np.tile(np.repeat([0.0, 60.0, 20.0, 80.0, 0.0, 40.0], 50), 2)  # %


def driven(push=PUSH, rate=RATE):
    """The angle [deg] of an arm that a command moves: it follows late, and swings."""
    theta, speed, thrust, out = 0.0, 0.0, 0.0, []
    for u in push:
        out.append(np.degrees(theta))
        for _ in range(20):
            thrust += (u / 100.0 - thrust) / 0.1 / rate / 20.0
            speed += (36.0 * (thrust * thrust - np.sin(theta)) - 1.5 * speed) / rate / 20.0
            theta += speed / rate / 20.0
    return np.array(out)


DRIVEN = driven()
LONG = np.arange(len(PUSH)) / RATE
MAPPED = ("--time", "t:s", "--theta", "x:deg")


def lines(*columns, form="{:.4f}", split=",", end="\n"):
    """Rows of text."""
    return "".join(split.join(form.format(x) for x in row) + end for row in zip(*columns))


NUMBERS = lines(TIME, ANGLE)


def comma(text):
    return text.replace(".", ",")


def put(tmp_path, content, name="run.csv", encoding="utf-8"):
    path = tmp_path / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode(encoding))
    return path


def imported(tmp_path, path, *options):
    """Import, and read the recording."""
    bag = tmp_path / f"bag{len(list(tmp_path.iterdir()))}"
    assert main([str(path), str(bag), *options]) == 0
    return read(bag)


def refused(capsys, *arguments):
    """The one line that is said, and no more."""
    try:
        code = main([str(one) for one in arguments])
    except SystemExit as error:
        code = error.code
    said = capsys.readouterr().err
    assert code == 2
    assert said.startswith("import: ")
    assert said.count("\n") == 1
    return said


def workbook(path, rows, title="Data", more=()):
    book = openpyxl.Workbook()
    sheet = book.active
    sheet.title = title
    for row in rows:
        sheet.append(row)
    for name, others in more:
        other = book.create_sheet(name)
        for row in others:
            other.append(row)
    book.save(path)
    return path


def table_rows(*head):
    return [*head, *([float(t), float(x), float(u)] for t, x, u in zip(TIME, ANGLE, DUTY))]
