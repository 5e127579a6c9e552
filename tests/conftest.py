"""Shape annotations of the backend's maths are checked at run time in tests."""

import os

import pytest
from hypothesis import HealthCheck, settings
from jaxtyping import install_import_hook
from primdiffusion.runtime.machine import share_processors
from support import kernels

share_processors()
kernels.share()
settings.register_profile("any_speed", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("any_speed")

CHECKED = [
    f"primdiffusion.{module}"
    for module in (
        "geometry.rotation",
        "geometry.camera",
        "geometry.surface",
        "body.model",
        "primitives.primitives",
        "primitives.anchors",
        "render.reference",
    )
]
install_import_hook(CHECKED, "beartype.beartype")


def pytest_collection_modifyitems(items):
    items.sort(key=lambda item: item.get_closest_marker("long") is None)
    if os.name == "nt":
        for item in items:
            if item.get_closest_marker("unix"):
                item.add_marker(pytest.mark.skip(reason="Windows has nothing of the kind"))


@pytest.fixture(scope="module")
def one_thread():
    """torch computes on one thread, so that sums have one order."""
    import torch  # after `share_processors`

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)
