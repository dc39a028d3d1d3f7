# SPDX-License-Identifier: Apache-2.0
"""Compilation by numba, with a cache on disk that notices every change of the source.

numba renews its cache only when the file of the cached function changes. But the compiled code also contains functions
and constants from other files: after a change there, numba runs the old code. Its manual names this limit
(https://numba.readthedocs.io/en/stable/user/jit.html#cache). Here the names of the cache files contain a hash of the
function's module and of all modules of these packages that it imports, directly or indirectly.

numba also numbers the files of a function's signatures. Two processes that compile two signatures at the same time
may give both the same number, and one signature then runs the code of the other, which ends in wrong numbers or a
segmentation fault. Here the name of a file contains a hash of its signature.

The rest works as in numba: where the cache is, `NUMBA_CACHE_DIR`, and the user's cache folder if the folder of the
source is read-only.

Every compiled function of these packages uses the `njit` of this module.
"""

from __future__ import annotations

import hashlib
import re
import sys
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import numba
from numba.core.caching import CompileResultCacheImpl, FunctionCache, IndexDataCacheFile
from numba.core.runtime import rtsys

F = TypeVar("F", bound=Callable[..., Any])

VERSIONS = 3
"""Versions of a function that stay in the cache, so that a return to an earlier source costs nothing. A choice."""

_IMPORT = re.compile(r"^(?:from (aeropend_[\w.]+) import (\([^)]*\)|.*)|import (aeropend_[\w.]+))", re.MULTILINE)


def njit(cached: bool = True, **options: Any) -> Callable[[F], F]:
    """Decorate a function that numba compiles, like `numba.njit`.

    Args:
        cached: keep the compiled code on disk. False for functions that are only inlined into others.
        **options: of `numba.njit`, without `cache`.

    Returns:
        The decorator.
    """

    def decorate(function: F) -> F:
        compiled: F = numba.njit(**options)(function)
        if cached and compiled is not function:  # it is the function with NUMBA_DISABLE_JIT
            vars(compiled)["_cache"] = _Cache(function)
        return compiled

    return decorate


equation = njit(forceinline=True, error_model="numpy")
"""Decorator of an equation: it is compiled into its callers, without a test for zero before each division."""


@cache
def source_hash(module: str) -> str:
    """Hash of a module's source and of the sources of all modules of these packages that it imports at its top.

    Args:
        module: its name. It is imported, or its imports are done.
    """
    return _hash(b"".join(f"{name}\n".encode() + _source(name) for name in sorted(_reachable(module))))


def _hash(content: bytes) -> str:
    return hashlib.blake2b(content, digest_size=6).hexdigest()


def _reachable(module: str) -> set[str]:
    found: set[str] = set()
    waiting = [module]
    while waiting:
        name = waiting.pop()
        if name not in found and name in sys.modules:  # not what is imported for the type checker only
            found.add(name)
            waiting.extend(_imports(name))
    return found


@cache
def _imports(module: str) -> tuple[str, ...]:
    """Names that may be modules of these packages, from the import statements at the top of a module."""

    def names() -> Iterator[str]:
        for origin, imported, whole in _IMPORT.findall(_source(module).decode()):
            yield origin or whole
            for name in re.findall(r"\w+", imported):
                yield f"{origin}.{name}"

    return tuple(names())


@cache
def _source(module: str) -> bytes:
    """The source of a module, also from a zip archive; empty if it is not there."""
    found = sys.modules[module]
    with suppress(OSError, AttributeError):
        return bytes(found.__loader__.get_data(found.__file__))  # type: ignore[union-attr]
    return b""


class _Names(CompileResultCacheImpl):
    """Puts the hash of the sources into the names of the cache files, and removes the files of old versions."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self._hash = source_hash(function.__module__)
        super().__init__(function)

    def get_filename_base(self, fullname: str, abiflags: str) -> str:
        self._function = fullname
        return f"{super().get_filename_base(fullname, abiflags)}.{self._hash}"

    def prune(self) -> None:
        """Remove all versions of this function except the latest ones. Files of numba alone count as one version."""
        versions: dict[str | None, list[Path]] = {}
        named = re.compile(re.escape(self._function) + r"-\d+\.py\w+(?:\.([0-9a-f]{12}))?\.(?:nbi|[0-9a-f]+\.nbc)")
        for path in Path(self.locator.get_cache_path()).iterdir():
            if match := named.fullmatch(path.name):
                versions.setdefault(match[1], []).append(path)
        with suppress(OSError):  # another process removes the same files
            latest = sorted(versions, key=lambda version: max(path.stat().st_mtime for path in versions[version]))
            for version in latest[:-VERSIONS]:
                for path in versions[version]:
                    path.unlink(missing_ok=True)


class _Files(IndexDataCacheFile):
    """Gives each signature a file that no other signature has."""

    def save(self, key: Any, data: Any) -> None:
        """Save the compiled code of a signature."""
        name = self._data_name_pattern.replace("{number:d}", _hash(repr(key).encode()))
        self._save_data(name, data)
        self._save_index({**self._load_index(), key: name})


class _Cache(FunctionCache):
    _impl_class = _Names

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)
        self._cache_file = _Files(self._cache_path, self._impl.filename_base, self._impl.locator.get_source_stamp())

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Load the compiled code of a signature.

        numba first loads all that its compiler knows, which takes a third of a node's start-up. Of that, code from the
        cache needs only the functions that manage memory.
        """
        rtsys.initialize(target_context)
        with self._guard_against_spurious_io_errors():
            return self._load_overload(sig, target_context)

    def save_overload(self, sig: Any, data: Any) -> None:
        super().save_overload(sig, data)
        self._impl.prune()
