"""No verdict of the suite depends on how fast the machine is."""

import time

from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st


@given(st.integers().map(lambda number: time.sleep(0.25) or number))
@settings(max_examples=12)
def test_slow_examples_are_no_failure(number):
    assert isinstance(number, int)


def test_every_property_is_tested_without_a_deadline():
    assert settings.default.deadline is None
    assert HealthCheck.too_slow in settings.default.suppress_health_check


def test_hangs_alone_reach_the_time_limit(pytestconfig):
    assert float(pytestconfig.getini("timeout")) >= 1800
