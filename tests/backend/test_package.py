"""`import primdiffusion` is enough for a first script, and loads torch when it is needed."""

import doctest
import inspect
import os
import subprocess
import sys

import numpy as np
import primdiffusion as pd
import pytest
from primdiffusion.reconstruction import from_pictures
from support.errors import refused


def test_the_example_of_each_name_runs_after_those_before_it(tmp_path, checkpoint, monkeypatch):
    monkeypatch.chdir(tmp_path)
    np.savez("walk.npz", poses=np.zeros((6, 72)))
    monkeypatch.setattr("primdiffusion.diffusion.checkpoint.default_checkpoint", lambda: checkpoint)
    monkeypatch.setattr(
        from_pictures,
        "FIT_STAGES",
        [from_pictures.FitStage(48, from_pictures.Stage(2, 0.03), steps) for steps in (1, 0)],
    )
    names = [name for name in pd.__all__ if name != "__version__"]
    parser, seen = doctest.DocTestParser(), {"pd": pd}
    for name in names:
        function = getattr(pd, name)
        example = parser.get_doctest(inspect.getdoc(function), seen, name, inspect.getsourcefile(function), None)
        assert example.examples, f"{name} has no example"
        said = []
        doctest.DocTestRunner().run(example, out=said.append, clear_globs=False)
        assert not said, "".join(said)
        seen = example.globs
    assert set(pd.__all__) <= set(dir(pd))
    assert names.index("place") < names.index("march") < names.index("reconstruct")


def test_torch_is_loaded_with_the_first_name_that_is_used():
    script = (
        "import sys, primdiffusion as pd; assert 'torch' not in sys.modules; pd.Camera; assert 'torch' in sys.modules"
    )
    subprocess.run([sys.executable, "-c", script], check=True, timeout=500)


def test_an_unknown_name_is_an_attribute_error():
    with refused(AttributeError, "nothing"):
        pd.nothing  # noqa: B018


def ran(*words: str, **environment: str) -> subprocess.CompletedProcess:
    """The command line in a process of its own."""
    paths = os.pathsep.join(filter(None, (environment.pop("PYTHONPATH", ""), os.environ.get("PYTHONPATH", ""))))
    everything = {**os.environ, **environment, "PYTHONPATH": paths}
    command = [sys.executable, "-m", "primdiffusion", *words]
    return subprocess.run(command, env=everything, capture_output=True, text=True, timeout=300, check=False)


@pytest.mark.unix
def test_an_odd_environment_is_no_traceback(tmp_path):
    for name in ("cli", "commands", "formats", "serve", "utils"):  # modules of other programs, not to be imported
        (tmp_path / f"{name}.py").write_text("raise RuntimeError('the wrong module')\n")
    odd = dict.fromkeys(("HOME", "XDG_CACHE_HOME", "NUMBA_CACHE_DIR", "TMPDIR"), "/dev/null/nowhere")
    done = ran("info", **odd, PYTHONPATH=str(tmp_path))
    assert done.returncode == 0, done.stderr


def test_a_package_that_cannot_be_imported_is_one_sentence(tmp_path):
    (tmp_path / "numpy").mkdir()
    (tmp_path / "numpy" / "__init__.py").write_text("raise ImportError('built for another Python')\n")
    done = ran("info", PYTHONPATH=str(tmp_path))
    assert done.returncode == 1
    assert "numpy" in done.stderr or "another Python" in done.stderr
    assert "Traceback" not in done.stderr
