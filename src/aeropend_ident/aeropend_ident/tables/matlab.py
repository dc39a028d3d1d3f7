# SPDX-License-Identifier: Apache-2.0
"""The variables of a MATLAB file, up to version 7.2 by scipy, of 7.3 by h5py. A program of its own, for `files`.

    python -m aeropend_ident.tables.matlab FILE >variables.npz

A damaged file may crash or block the library that reads it. In a process of its own this does no harm; its memory and
CPU time are limited. Exit code 2 with one line on standard error: the file cannot be read.
"""

from __future__ import annotations

import io
import json
import resource
import sys
import warnings
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.io.matlab import MatlabOpaque

from aeropend_ident.tables.files import HDF5, MOST_UNPACKED, OPAQUE, Arrays, is_matlab_4
from aeropend_ident.tables.table import MOST_NUMBERS, TableError, check_size

DEEPEST = 4
"""Greatest depth of nested structures (choice)."""

MOST_RECORDS = 64
"""Greatest number of records in an array of structures, as of the signals of a scope (choice)."""

MOST_MEMORY = 6 << 30
"""[bytes] Limit of the memory of this program (choice)."""

MOST_SECONDS = 60
"""[s] Limit of its CPU time (choice)."""


def read(path: Path) -> Arrays:
    """The variables of a file; the names of fields of structures have dots.

    Raises:
        TableError: the file cannot be read.
    """
    with path.open("rb") as file:
        start = file.read(8)
    return _hdf5(path) if start in (HDF5, b"MATLAB 7") and _is_hdf5(path) else _mat(path)


def _is_hdf5(path: Path) -> bool:
    """Whether a file is HDF5, which starts at byte 512 after a header of MATLAB."""
    with path.open("rb") as file:
        return file.read(8) == HDF5 or (file.seek(512) == 512 and file.read(8) == HDF5)


def _mat(path: Path) -> Arrays:
    """Read a file up to version 7.2."""
    from scipy.io import loadmat

    with path.open("rb") as file:
        old = is_matlab_4(file.read(132))
    if not old:  # whose matrices are not compressed
        _check_mat(path)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of variables that it cannot read: they are missing, which is said
            variables = loadmat(path, squeeze_me=False, struct_as_record=True, chars_as_strings=True)
    except MemoryError:
        raise
    except Exception as error:  # whatever is in the file, scipy raises what its parsers raise
        why = " ".join(str(error).split())[:80]
        raise TableError(f"{path}: cannot be read as a MATLAB file ({why}): save it again with save(..., '-v7')"
                         ) from None
    return dict(_flat({k: v for k, v in variables.items() if not k.startswith("__")}))


def _check_mat(path: Path) -> None:
    """Refuse a file that is too large when unpacked; compressed elements are unpacked to measure them."""
    unpacked = 0
    with path.open("rb") as file:
        order = "big" if file.read(128)[126:128] == b"MI" else "little"
        while len(tag := file.read(8)) == 8:
            kind, length = int.from_bytes(tag[:4], order), int.from_bytes(tag[4:], order)  # type: ignore[arg-type]
            if kind != 15:  # compressed
                unpacked += length
                file.seek(length, io.SEEK_CUR)
            else:
                unpacked += _unpacked(file, length, MOST_UNPACKED - unpacked)
            if unpacked > MOST_UNPACKED:
                raise TableError(f"{path}: would take more than {MOST_UNPACKED >> 20} MiB unpacked: save only what is "
                                 "needed")


def _unpacked(file: io.BufferedReader, length: int, most: int) -> int:
    """[bytes] Unpacked size of compressed data; the count ends soon after `most`."""
    unzip = zlib.decompressobj()
    total = 0
    while length > 0 and total <= most:
        part = file.read(min(length, 1 << 16))
        if not part:
            break
        length -= len(part)
        try:
            while part and total <= most:
                total += len(unzip.decompress(part, 1 << 20))
                part = unzip.unconsumed_tail
        except zlib.error:
            break  # reading says what is wrong
    return total


def _flat(tree: Mapping[str, Any], prefix: str = "", depth: int = 0) -> Iterator[tuple[str, NDArray[Any]]]:
    for name, value in tree.items():
        array = np.asarray(value)
        while array.dtype == object and array.size == 1 and isinstance(array.flat[0], np.ndarray):
            array = array.flat[0]
        if isinstance(value, MatlabOpaque):
            yield prefix + name.removeprefix("None") + OPAQUE, np.zeros(0)
        elif array.dtype.names and array.size == 1 and depth < DEEPEST:
            record = array.flat[0]
            yield from _flat({key: record[key] for key in array.dtype.names}, f"{prefix}{name}.", depth + 1)
        elif array.dtype.names and 1 < array.size <= MOST_RECORDS and depth < DEEPEST:
            for k, record in enumerate(array.flat):
                fields = {key: record[key] for key in array.dtype.names}
                label = _text(fields.pop("label", None)) or f"{name}({k + 1})"
                yield from _flat(fields, f"{prefix}{label}.", depth + 1)
        elif array.dtype == object and 1 < array.size <= MOST_RECORDS and depth < DEEPEST:
            yield from _flat({f"{name}{{{k + 1}}}": cell for k, cell in enumerate(array.flat)}, prefix, depth + 1)
        else:
            yield prefix + name, array


def _text(value: Any) -> str:
    """The text in an array; "" without one."""
    array = np.asarray(value)
    return str(array.flat[0]).strip() if array.dtype.kind == "U" and array.size == 1 else ""


def _hdf5(path: Path) -> Arrays:
    """Read a file of version 7.3, which is HDF5 with transposed arrays."""
    try:
        import h5py
    except ImportError:
        raise TableError(f"{path}: is a MATLAB file of version 7.3: save it with save(..., '-v7'), or install h5py"
                         ) from None
    found: Arrays = {}
    total = 0

    def walk(group: Any, prefix: str, depth: int) -> None:
        nonlocal total
        for name in group:
            # links may point to other files
            if name.startswith("#") or not isinstance(group.get(name, getlink=True), h5py.HardLink):
                continue
            one = group[name]
            if isinstance(one, h5py.Group):
                if depth < DEEPEST:
                    walk(one, f"{prefix}{name}.", depth + 1)
            elif one.dtype.kind in "biuf" and not one.is_virtual and not one.external and one.shape:
                total += one.size
                if total > MOST_NUMBERS:
                    check_size(total, 1, path)
                if one.attrs.get("MATLAB_class", b"double") not in (b"char", b"cell") and one.size > 1:
                    found[prefix + name] = np.asarray(one[()]).T

    try:
        with h5py.File(path, "r") as file:
            walk(file, "", 0)
    except (TableError, MemoryError):
        raise
    except Exception as error:  # as above
        raise TableError(f"{path}: cannot be read as HDF5 ({' '.join(str(error).split())[:80]})") from None
    return found


def main() -> int:
    """Run the program; returns the exit code."""
    resource.setrlimit(resource.RLIMIT_AS, (MOST_MEMORY, MOST_MEMORY))
    resource.setrlimit(resource.RLIMIT_CPU, (MOST_SECONDS, MOST_SECONDS))
    path = Path(sys.argv[1])
    try:
        found = read(path)
    except (TableError, OSError) as error:
        print(error, file=sys.stderr)
        return 2
    except MemoryError:
        print(f"{path}: is too large for the memory of this machine", file=sys.stderr)
        return 2
    arrays: dict[str, Any] = {f"a{k}": array if array.dtype.kind in "biuf" else np.zeros(0)
                              for k, array in enumerate(found.values())}
    arrays["names"] = np.frombuffer(json.dumps(list(found)).encode(), dtype=np.uint8)
    out = io.BytesIO()  # an archive needs a seekable file
    np.savez(out, **arrays)
    sys.stdout.buffer.write(out.getbuffer())
    return 0


if __name__ == "__main__":
    sys.exit(main())
