"""`march`: batches, backgrounds, the released code's settings, and what it refuses."""

import dataclasses
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from march_scenes import camera_at, one_box, random_boxes
from primdiffusion.geometry.camera import Camera
from primdiffusion.primitives.primitives import Primitives
from primdiffusion.render import cuda
from primdiffusion.render.cpu.march import march_cpu
from primdiffusion.render.image import Rendering
from primdiffusion.render.lattice import RELEASED, MarchSettings, Span
from primdiffusion.render.march import march
from primdiffusion.render.reference import march_reference
from support.errors import refused

FIELDS = ("rgb", "alpha", "depth", "first_hit")


def people(*seeds: int) -> Primitives:
    """A batch [len(seeds)] of boxes in float32."""
    sets = [random_boxes(9, seed).to(dtype=torch.float32) for seed in seeds]
    return Primitives(*(torch.stack([getattr(boxes, name) for boxes in sets]) for name in vars(sets[0])))


def views(count: int) -> Camera:
    """A batch [count] of cameras around the origin."""
    cameras = [camera_at((0.1 * i, 0.05, 0.5), width=14, height=11).to(dtype=torch.float32) for i in range(count)]
    intrinsics, poses = (torch.stack([getattr(c, n) for c in cameras]) for n in ("intrinsics", "world_to_camera"))
    return Camera(intrinsics, poses, 14, 11)


def broken(record, **fields):
    """A record whose shapes its own checks would refuse; they are off outside of tests."""
    copy = dataclasses.replace(record)
    for name, value in fields.items():
        object.__setattr__(copy, name, value)
    return copy


def one(record, *index: int):
    return record.map(lambda tensor: tensor[index])


def test_people_and_views_broadcast_to_a_batch_of_pictures():
    boxes, cameras = people(0, 1), views(3)
    got = march(boxes.map(lambda tensor: tensor[:, None]), cameras)
    assert got.rgb.shape == (2, 3, 11, 14, 3)
    assert got.depth.shape == (2, 3, 11, 14)
    for p in range(2):
        for v in range(3):
            alone = march(one(boxes, p), one(cameras, v))
            for name in FIELDS:
                assert torch.equal(getattr(got, name)[p, v], getattr(alone, name)), name
    assert torch.equal(march(one(boxes, 1), cameras).rgb, got.rgb[1])
    assert torch.equal(march(boxes, one(cameras, 2)).rgb, got.rgb[:, 2])


def test_a_camera_may_share_its_lens_between_views():
    cameras = views(3)
    shared = dataclasses.replace(cameras, intrinsics=cameras.intrinsics[0])
    assert torch.equal(march(one(people(0), 0), shared).rgb, march(one(people(0), 0), cameras).rgb)


def test_gradients_of_a_batch_are_the_sums_over_its_pictures():
    boxes, cameras = people(0, 1), views(2)
    weight = torch.rand((2, 2, 11, 14, 3), generator=torch.Generator().manual_seed(0))

    leaves = boxes.map(lambda tensor: tensor.clone().requires_grad_())
    (march(leaves.map(lambda tensor: tensor[:, None]), cameras).rgb * weight).sum().backward()
    for p in range(2):
        alone = one(boxes, p).map(lambda tensor: tensor.clone().requires_grad_())
        for v in range(2):
            (march(alone, one(cameras, v)).rgb * weight[p, v]).sum().backward()
        for name, tensor in vars(alone).items():
            torch.testing.assert_close(getattr(leaves, name).grad[p], tensor.grad, rtol=1e-4, atol=1e-5)


def test_spans_belong_to_their_pictures():
    boxes, cameras = one(people(0), 0), views(2)
    near, far = torch.zeros((2, 11, 14)), torch.full((2, 11, 14), torch.inf)
    far[1] = 0
    got = march(boxes, cameras, span=Span(near, far))
    torch.testing.assert_close(got.rgb[0], march(boxes, one(cameras, 0)).rgb, atol=1e-5, rtol=0)
    assert got.alpha[1].max() == 0


def test_people_together_are_one_picture():
    boxes, camera = people(0, 1), one(views(1), 0)
    both = march(Primitives.together([one(boxes, 0), one(boxes, 1)]), camera)
    swapped = march(Primitives.together([one(boxes, 1), one(boxes, 0)]), camera)
    assert both.alpha.sum() > march(one(boxes, 0), camera).alpha.sum()
    torch.testing.assert_close(both.rgb, swapped.rgb, atol=1e-5, rtol=0)
    batch = Primitives.together([boxes, boxes])
    assert batch.rgb.shape == (2, 18, 3, 8, 8, 8)
    assert batch.half_extent.shape == (2, 18, 3)


def test_released_settings_look_through_pixel_corners_every_millimetre_in_index_order():
    boxes = random_boxes(9, 2, density=200.0)
    camera = camera_at((0.1, 0.05, 0.5), width=14, height=11)
    corners = dataclasses.replace(camera, intrinsics=camera.intrinsics.clone())
    corners.intrinsics[:2, 2] += 0.5  # the centre of pixel (u, v) then looks where (u, v) itself did
    rule = MarchSettings(step=0.001, strides=(1,), compositing="index_order")
    got = march(boxes, camera, RELEASED)
    assert torch.equal(got.rgb, march_reference(boxes, corners, rule).rgb)
    assert not torch.equal(got.rgb, march(boxes, camera).rgb)
    for name in FIELDS:  # the fast back end has the same mode
        fast = march(boxes.to(dtype=torch.float32), camera.to(dtype=torch.float32), RELEASED)
        finite = torch.isfinite(getattr(got, name))
        torch.testing.assert_close(getattr(fast, name)[finite].double(), getattr(got, name)[finite], atol=2e-3, rtol=0)


def test_gradients_reach_the_boxes_through_the_released_settings():
    boxes, camera = one(people(3), 0), one(views(1), 0)
    leaves = boxes.map(lambda tensor: tensor.clone().requires_grad_())
    march(leaves, camera, RELEASED).rgb.sum().backward()
    assert all(tensor.grad.abs().sum() > 0 for tensor in vars(leaves).values())


@pytest.mark.parametrize("settings", [MarchSettings(), RELEASED])
def test_on_cuda_devices_a_batch_is_one_call_and_one_person_is_not_copied(settings, monkeypatch):
    """The call is recorded and answered by the CPU's back end: which tensors go in, and where pictures come out."""
    calls = []

    def march_cuda(primitives, camera, settings, span):
        calls.append((primitives.position.shape[0], camera.intrinsics.shape[0], span))
        people = [one(primitives, i % len(primitives.position)) for i in range(len(camera.intrinsics))]
        pictures = [march_cpu(person, one(camera, i), settings) for i, person in enumerate(people)]
        return Rendering(*(torch.stack([getattr(picture, name) for picture in pictures]) for name in FIELDS))

    backend = pytest.importorskip("primdiffusion.render.cuda.march")
    boxes, cameras = people(0, 1), views(3)
    scenes = [
        (boxes.map(lambda tensor: tensor[:, None]), cameras, (6, 6)),
        (one(boxes, 0), cameras, (1, 3)),
        (boxes, one(cameras, 1), (2, 2)),
        (one(boxes, 0), one(cameras, 0), (1, 1)),
    ]
    expected = [march(person, view, settings) for person, view, _ in scenes]
    monkeypatch.setattr(cuda, "available", lambda device: True)
    monkeypatch.setattr(backend, "march_cuda", march_cuda)
    for (person, view, sizes), pictures in zip(scenes, expected, strict=True):
        got = march(person, view, settings)
        assert calls[-1] == (*sizes, None)
        for name in FIELDS:
            assert torch.equal(getattr(got, name), getattr(pictures, name)), name
    march(boxes.to(dtype=torch.float64), one(cameras, 0).to(dtype=torch.float64), settings)
    assert len(calls) == len(scenes)


def test_reflected_frames_mirror_what_is_in_the_box():
    box = dataclasses.replace(one_box(0.05, 0.0), density=random_boxes(1, 4).density)
    camera = camera_at((0.0, 0.0, 0.5), width=15, height=15)
    mirrored = dataclasses.replace(box, rotation=torch.diag(torch.tensor([-1.0, 1.0, 1.0])).double()[None])
    torch.testing.assert_close(march(mirrored, camera).alpha, march(box, camera).alpha.flip(1))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_broken_scenes_are_rejected_with_a_way_out(dtype):
    boxes, camera = random_boxes(3).to(dtype=dtype), camera_at((0.0, 0.0, 0.5)).to(dtype=dtype)
    with refused(ValueError, "rotation"):
        march(dataclasses.replace(boxes, rotation=boxes.rotation * 2), camera)
    with refused(ValueError, "density is -1"):
        march(dataclasses.replace(boxes, density=boxes.density * 0 - 1), camera)
    with refused(ValueError, "half_extent"):
        march(dataclasses.replace(boxes, half_extent=boxes.half_extent * -torch.inf), camera)
    with refused(ValueError, "broadcast"):
        march(people(0, 1).to(dtype=dtype), views(3).to(dtype=dtype))
    with refused(ValueError, "dimensions"):
        march(broken(people(0, 1), rgb=people(0, 1, 2).rgb), camera)
    with refused(ValueError, "empty"):
        march(people(0, 1).map(lambda tensor: tensor[:0]).to(dtype=dtype), camera)
    with refused(ValueError, "span.near", "(5, 5)"):
        march(boxes, camera, span=Span(torch.zeros(5, 5), torch.zeros(5, 5)))
    with refused(ValueError, "span.far", "NaN"):
        march(boxes, camera, span=Span(torch.zeros(20, 24), torch.full((20, 24), torch.nan)))
    with refused(ValueError, "primitives.rgb", "(3, 1, 8, 8, 8)"):
        march(broken(boxes, rgb=boxes.rgb[:, :1]), camera)
    with refused(ValueError, "dimensions"):
        march(broken(boxes, density=boxes.density[0, 0]), camera)
    with refused(ValueError, "cpu", "meta"):
        march(dataclasses.replace(boxes, rgb=boxes.rgb.to("meta")), camera)
    with refused(ValueError, "compositing", "nearest"):
        MarchSettings(compositing="nearest")  # pyright: ignore[reportArgumentType]
    for strides in ((), (1, 2), (4, 3), (4, 2, 0), (2.5,), (2**40, 1)):
        with refused(ValueError, "strides"):
            MarchSettings(strides=strides)  # pyright: ignore[reportArgumentType]
    for step in (0.0, -1.0, float("nan"), float("inf")):
        with refused(ValueError, "step"):
            MarchSettings(step=step)
    with refused(ValueError, "pixel_centre"):
        MarchSettings(pixel_centre=float("nan"))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_cameras_whose_rays_start_nowhere_are_rejected(dtype):
    boxes, camera = random_boxes(3).to(dtype=dtype), camera_at((0.0, 0.0, 0.5)).to(dtype=dtype)
    flat = torch.tensor([1.0, 1.0, 0.0], dtype=dtype)[:, None]
    with refused(ValueError, "0 x 20 pixels"):
        march(boxes, dataclasses.replace(camera, width=0))
    with refused(ValueError, "camera.intrinsics"):
        march(boxes, dataclasses.replace(camera, intrinsics=camera.intrinsics * torch.nan))
    for change in (2.0, 0.0, flat):
        with refused(ValueError, "world_to_camera"):
            march(boxes, dataclasses.replace(camera, world_to_camera=camera.world_to_camera * change))
    for axis in (0, 1):
        lens = camera.intrinsics.clone()
        lens[axis, axis] = 0
        with refused(ValueError, "focal lengths"):
            march(boxes, dataclasses.replace(camera, intrinsics=lens))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_boxes_that_would_take_hours_are_rejected(dtype):
    boxes, camera = random_boxes(3).to(dtype=dtype), camera_at((0.0, 0.0, 0.5)).to(dtype=dtype)
    boxes.half_extent[1] = 1e9
    with refused(ValueError, "box 1"):
        march(boxes, camera)
    assert march(boxes, camera, MarchSettings(step=1e8)).alpha.shape == (20, 24)


@pytest.mark.skipif(not Path("/proc/self/clear_refs").exists(), reason="only Linux tells the peak since a moment")
def test_a_frame_grows_the_process_by_less_than_64_mb():
    """All memory, torch's too, in a process that has drawn nothing but a thumbnail before."""
    script = (
        "import gc, torch\n"
        "from march_scenes import camera_at, random_boxes\n"
        "from primdiffusion.render.march import march\n"
        "def kilobytes(name):\n"
        "    return next(int(line.split()[1]) for line in open('/proc/self/status') if line.startswith(name))\n"
        "boxes = random_boxes(1024, 28, spread=0.4).to(dtype=torch.float32)\n"
        "def camera(side):\n"
        "    return camera_at((0.2, 0.1, 1.5), fov=0.6, width=side, height=side).to(dtype=torch.float32)\n"
        "march(random_boxes(4).to(dtype=torch.float32), camera(16)); gc.collect()\n"
        "open('/proc/self/clear_refs', 'w').write('5')\n"
        "before = kilobytes('VmRSS'); march(boxes, camera(512)); print(kilobytes('VmHWM') - before)\n"
    )
    path = os.pathsep.join([str(Path(__file__).parents[1]), *sys.path])
    done = subprocess.run(
        [sys.executable, "-c", script], env=os.environ | {"PYTHONPATH": path}, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert 0 < int(done.stdout) < 64_000


def test_tensors_may_be_views_and_gradients_recorded_off_for_good_or_for_one_input():
    boxes, camera = one(people(0), 0), one(views(1), 0)
    plain = march(boxes, camera)

    def strided(tensor):
        return torch.stack([tensor, tensor], dim=-1)[..., 0]

    for same in (march(boxes.map(strided), camera.map(strided)), march(*in_inference_mode(boxes, camera))):
        for name in FIELDS:
            assert torch.equal(getattr(same, name), getattr(plain, name)), name
    leaf = boxes.position.clone().requires_grad_()
    total = march(dataclasses.replace(boxes, position=leaf), camera).rgb.sum()
    once, again = (torch.autograd.grad(total, leaf, retain_graph=True)[0] for _ in range(2))
    assert torch.equal(once, again)
    assert once.abs().sum() > 0
    with torch.no_grad():
        assert not march(dataclasses.replace(boxes, position=leaf), camera).rgb.requires_grad


def in_inference_mode(*records):
    with torch.inference_mode():
        return [record.map(torch.clone) for record in records]


@pytest.mark.parametrize("offset", [1e3, 1e6])
def test_a_scene_far_from_the_origin_is_drawn_as_it_is_there(offset):
    """In float32 boxes lie where rounding puts them; the picture is that of these boxes, exactly."""
    boxes, camera = random_boxes(12, 5), camera_at((0.1, 0.05, 0.6))
    away = torch.tensor([offset, 0.0, -offset], dtype=torch.float64)
    pose = camera.world_to_camera.clone()
    pose[:, 3] -= pose[:, :3] @ away
    there = dataclasses.replace(boxes, position=boxes.position + away).to(dtype=torch.float32)
    view = dataclasses.replace(camera, world_to_camera=pose).to(dtype=torch.float32)
    exact = march(there.to(dtype=torch.float64), view.to(dtype=torch.float64))
    assert exact.alpha.max() > 0.9
    torch.testing.assert_close(march(there, view).rgb.double(), exact.rgb, atol=2e-5, rtol=0)


def test_a_device_without_a_back_end_borrows_the_cpu_s(monkeypatch):
    primitives, camera = one(people(0), 0), one(views(1), 0)
    expected = march(primitives, camera)
    asked = iter((True, False))
    monkeypatch.setattr("primdiffusion.render.march._borrows_cpu", lambda _device: next(asked))
    found = march(primitives, camera)
    assert torch.equal(found.rgb, expected.rgb)
    assert next(asked, None) is None
