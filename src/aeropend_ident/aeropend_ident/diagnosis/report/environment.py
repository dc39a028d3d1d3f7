# SPDX-License-Identifier: Apache-2.0
"""How the templates of the pages are read."""

from __future__ import annotations

from jinja2 import Environment, PackageLoader, StrictUndefined

from aeropend_ident.diagnosis.report.number_format import percent, probability, quantity


def environment() -> Environment:
    """The templates, with the filters that they use for numbers."""
    made = Environment(loader=PackageLoader("aeropend_ident", "diagnosis/report/templates"), autoescape=True,
                       trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True, undefined=StrictUndefined)
    made.filters.update(quantity=quantity, percent=percent, probability=probability)
    return made
