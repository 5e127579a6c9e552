"""Files, captures and the child's streams keep the rules of Windows, as far as Linux can apply them."""

import sys

import pytest
from support.windows_run import run_under_the_rules


@pytest.mark.long
@pytest.mark.skipif(sys.platform != "linux", reason="the rules are applied by looking into /proc")
def test_tests_of_files_and_children_pass_under_the_rules_of_windows():
    done = run_under_the_rules()
    assert done.returncode == 0, done.stdout[-4000:]
