"""Registers for a person: names of the fields, short numbers, units."""

from __future__ import annotations

import pytest

from ahrsd.cli.device.registers import described
from drivers.vn100.registers import REGISTERS


@pytest.mark.parametrize(
    ("number", "values", "text"),
    [
        (0, ("",), 'tag ""'),
        (5, (115200,), "baud 115200 Bd"),
        (6, (14, 1), "ador 14  port 1"),
        (21, (0.234, 0.0, 0.4212, 0.0, 0.0, -9.79375), "mag_ref [0.234 0 0.4212] gauss  "
         "gravity_ref [0 0 -9.79375] m/s^2"),
        (23, (1.0021, 0.0123456, 0, 0, 1, 0, 0, 0, 1, 0.12, -0.08, 7.1384e-05),
         "c [1.0021 0.0123456 0; 0 1 0; 0 0 1]  b [0.12 -0.08 7.1384e-05] gauss"),
        (75, (3, 40, 0x29, 0x7FFF, 0x0210, 0x000C),
         "async_mode 3  rate_divisor 40  groups 29  field_word [7FFF 0210 000C]"),
        (76, (0, 1, 0), "async_mode 0  rate_divisor 1  groups 00"),
        (206, ("0", "1"), "0 1  (fields are not documented)"),
    ],
)  # fmt: skip
def test_values_by_the_names_of_their_fields(number, values, text):
    assert described(number, values) == text


def test_every_register_with_defaults_can_be_described():
    for number, row in REGISTERS.items():
        for values in row.defaults.values():
            assert described(number, values)


def test_rows_that_rest_on_one_source_say_so():
    said = {number for number, row in REGISTERS.items() if row.unconfirmed}
    assert {32, 33, 38, 85, 115, 116, 206, 227} <= said
    assert not {1, 3, 4, 5, 6, 7, 23, 25, 26, 30, 44, 47, 75, 76, 77, 84} & said
