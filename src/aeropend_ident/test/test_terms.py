# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from aeropend_ident.identification.terms import Library, TermError, polynomials, terms_at, thesis_terms

VARIABLES = ("theta", "theta_dot", "i_a", "omega", "v_a")


def test_the_thesis_library_has_its_31_terms_in_the_order_of_the_thesis():
    names = thesis_terms(VARIABLES)
    assert len(names) == len(set(names)) == 31
    assert names[:8] == ["1", *VARIABLES, "theta*theta", "theta*theta_dot"]
    assert names[-10:-6] == ["sin(theta)", "cos(theta)", "sin(theta_dot)", "cos(theta_dot)"]
    assert len(polynomials(("x", "y", "z"), 3)) == 20


def test_terms_have_their_values():
    x = np.array([[0.3, -2.0, 0.5, 4.0, 1.5]])
    library = Library.of(VARIABLES, ["1", "sin(theta)", "theta_dot*abs(theta_dot)", "omega^1.5", "theta_dot^1.5",
                                     "sign(theta_dot)*i_a", "v_a^3"])
    assert library(x)[0] == pytest.approx([1.0, np.sin(0.3), -4.0, 8.0, -(2.0**1.5), -0.5, 3.375])


def test_compiled_terms_and_slopes_are_those_of_the_library():
    library = Library.of(VARIABLES, [*thesis_terms(VARIABLES), "omega^1.8", "theta_dot*abs(theta_dot)"])
    x, n = np.array([0.3, -2.0, 0.5, 4.0, 1.5]), len(library)
    value, slope = np.empty(n), np.empty((n, 5))
    terms_at(x, np.arange(n), library.table, value, slope)
    assert value == pytest.approx(library(x[None])[0])
    for k in range(5):
        step = 1e-6 * np.eye(5)[k]
        assert slope[:, k] == pytest.approx((library((x + step)[None]) - library((x - step)[None]))[0] / 2e-6, abs=1e-7)


@pytest.mark.parametrize("name", ["sin(phi)", "omega^", "omega**2", "exp(theta)", "sin(theta)^2", "theta+omega", ""])
def test_what_is_no_term_is_said(name):
    with pytest.raises(TermError) as error:
        Library.of(VARIABLES, [name])
    assert "\n" not in str(error.value)


def test_a_term_is_given_once():
    with pytest.raises(TermError, match="twice"):
        Library.of(VARIABLES, ["omega", "omega"])
