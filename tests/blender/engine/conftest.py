"""A human of the backend, the extension registered once for a file of tests, and a marcher on the GPU."""

from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import gpu
import pytest
from engine_stage import PYTHON, Oracle
from gpu_stage import placed

import blender_primdiffusion
from blender_primdiffusion.engine.gpu.march import GpuMarcher, GpuPayload


@pytest.fixture(scope="session")
def oracle(tmp_path_factory) -> Iterator[Oracle]:
    oracle = Oracle(tmp_path_factory.mktemp("oracle"))
    yield oracle
    oracle.close()


@pytest.fixture(scope="session")
def folder(oracle, tmp_path_factory) -> Path:
    """The folder of a human's file."""
    return oracle.make(tmp_path_factory.mktemp("human"))


@pytest.fixture(scope="module")
def extension() -> Iterator[None]:
    """Registered once: the child is kept warm between the tests."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PRIMDIFFUSION_PYTHON", PYTHON)
        blender_primdiffusion.register()
        yield
        blender_primdiffusion.unregister()


@pytest.fixture(scope="module")
def marcher() -> GpuMarcher:
    if not hasattr(gpu, "init"):
        pytest.skip("without a window Blender has a GPU context from 5.2 on")
    try:
        gpu.init()
        marcher = GpuMarcher()
    except (SystemError, RuntimeError) as error:
        pytest.skip(f"no GPU context: {error}")
    return marcher


@pytest.fixture(scope="module")
def backend(marcher, oracle, folder) -> SimpleNamespace:
    """The oracle, a human's folder, and numbers for the files of its poses."""
    return SimpleNamespace(oracle=oracle, folder=folder, files=iter(range(1000)))


@pytest.fixture(scope="module")
def payload(backend) -> GpuPayload:
    fields = placed(backend)
    return GpuPayload(fields["rgb"], fields["density"])
