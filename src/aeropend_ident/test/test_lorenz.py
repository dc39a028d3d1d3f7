# SPDX-License-Identifier: Apache-2.0

import pytest

from aeropend_ident.studies import lorenz


@pytest.mark.promise("Identification", "Each of the four methods finds the Lorenz system")
def test_lorenz_is_found_by_every_method():
    for method in ("sindy", "weak", "discrepancy-sindy", "discrepancy-weak"):
        found = lorenz.study(method, 0.05, 4)
        assert lorenz.is_exact(found.equations, lorenz.truth(method)), method
