# SPDX-License-Identifier: Apache-2.0
"""Recordings from arrays, as a bag would give them."""

import numpy as np

from aeropend_ident.bags.recording import Recording


def recording(t, theta, duty=None, **channels):
    """Readings (N,) at t (N,) as a bag would give them; what is not given was not measured."""
    n = len(t)
    stamps = np.rint(np.asarray(t) * 1e9).astype(np.int64)
    nothing, never, no_time = np.full(n, np.nan), np.empty(0), np.empty(0, np.int64)
    given = {"theta": theta, "duty": duty, **channels}
    columns = {c: np.asarray(given[c], float) if given.get(c) is not None else nothing
               for c in ("theta", "omega", "i_a", "v_a", "duty")}
    return Recording(path="bag", namespace="/", stamp_ns=stamps, received_ns=stamps, t=(stamps - stamps[0]) / 1e9,
                     **columns, channels=("theta",), period=float(np.median(np.diff(t))),
                     gaps=np.empty((0, 2), np.int64), duplicates=0, command_ns=no_time, command=never,
                     reference_ns=no_time, reference=never, truth=None, complete=True, notes=())
