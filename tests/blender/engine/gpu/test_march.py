"""The GPU's marcher draws what the backend's marcher draws."""

import dataclasses

import gpu
import numpy as np
import pytest
from engine_stage import STEP
from gpu_stage import boxes_of, pinhole, placed, read

from blender_primdiffusion.engine.gpu import march as gpu_march
from blender_primdiffusion.engine.gpu.march import Boxes, GpuPayload
from blender_primdiffusion.engine.gpu.refine import COARSENESS
from blender_primdiffusion.engine.view import NO_SURFACE_M, PARALLEL_M, view_from_matrices
from blender_primdiffusion.scene.convention import BLENDER_FROM_BACKEND

STEP_OF_8_BIT = 1 / 255
AT_EDGES = 2 / 255
"""Of single pixels: where a ray leaves or enters a box, float32 decides about a sample."""


def marched(marcher, people, view, **more) -> tuple[np.ndarray, np.ndarray]:
    march = marcher.march(people, view, STEP, **more)
    assert march.advance()
    return read(march.colour, view), read(march.depth, view)


def assert_equal(marcher, backend, people, view) -> np.ndarray:
    """Both pictures agree: `people` are payloads and the backend's boxes. Returns the backend's."""
    camera = {"intrinsics": view.intrinsics.tolist(), "world_to_camera": view.world_to_camera.tolist()}
    wanted, depth = backend.oracle.picture(
        [{"boxes": fields["file"]} for _, fields in people], {**camera, "clip": view.clip}, (view.width, view.height)
    )
    combined, shown = marched(marcher, [(payload, boxes_of(fields)) for payload, fields in people], view)
    error = np.abs(combined - wanted).max(-1)
    assert np.quantile(error, 0.999) <= STEP_OF_8_BIT
    assert error.max() <= AT_EDGES
    hit = depth < NO_SURFACE_M
    assert ((shown < NO_SURFACE_M) != hit).mean() <= 2e-3
    hit &= shown < NO_SURFACE_M
    assert hit.any()
    assert np.quantile(np.abs(shown + view.depth_offset - depth)[hit], 0.99, method="higher") < 1.1 * STEP
    return wanted


def turned(random: np.random.Generator, size: float) -> np.ndarray:
    """Rotations [24, 3, 3] by `size` radians about random axes."""
    axis = random.normal(size=(24, 3))
    x, y, z = (axis / np.linalg.norm(axis, axis=1, keepdims=True)).T
    zero = np.zeros(24)
    cross = np.stack([np.stack([zero, -z, y], -1), np.stack([z, zero, -x], -1), np.stack([-y, x, zero], -1)], -2)
    return np.eye(3) + np.sin(size) * cross + (1 - np.cos(size)) * cross @ cross


@pytest.mark.parametrize("number", range(8))
def test_a_pose_looks_as_in_the_backend(marcher, backend, payload, number):
    random = np.random.default_rng(number)
    fields = placed(backend, turned(random, 0.5))
    middle = fields["position"].mean(0)
    direction = random.normal(size=3) * [1, 0.4, 1]
    back = direction / np.linalg.norm(direction) * random.uniform(1.0, 5.0)
    picture = assert_equal(marcher, backend, [(payload, fields)], pinhole(middle, back))
    assert picture[..., 3].max() > 0.9


def test_several_people_are_mixed_where_they_overlap(marcher, backend, payload):
    fields = [placed(backend, translation=(0.15 * k, 0.0, 0.05 * k)) for k in range(3)]
    other = GpuPayload(fields[0]["rgb"][:, ::-1], fields[0]["density"])
    recoloured = {**fields[1], "file": str(backend.folder / "recoloured.npz")}
    names = ("position", "rotation", "half_extent", "density")
    np.savez(recoloured["file"], rgb=fields[1]["rgb"][:, ::-1], **{name: fields[1][name] for name in names})
    people = [(payload, fields[0]), (other, recoloured), (payload, fields[2])]
    assert_equal(marcher, backend, people, pinhole(fields[1]["position"].mean(0), (0.4, 0.9, 3.5)))


def test_ten_people_fit_one_picture(marcher, backend, payload):
    fields = [placed(backend, translation=(0.6 * (k % 5) - 1.2, 0.0, -0.8 * (k // 5))) for k in range(10)]
    assert_equal(marcher, backend, [(payload, one) for one in fields], pinhole(np.zeros(3), (0.3, 1.0, 6.0)))


def test_the_camera_may_be_inside_boxes_and_between_people(marcher, backend, payload):
    fields = [placed(backend), placed(backend, translation=(0.0, 0.0, 1.5))]
    people = [(payload, one) for one in fields]
    middle = fields[0]["position"].mean(0)
    assert_equal(marcher, backend, people, pinhole(middle, (0.02, 0.0, 0.12), angle=1.2))
    assert_equal(marcher, backend, people, pinhole(middle, (0.0, 0.0, 0.75), angle=1.5))
    nose = fields[0]["position"][np.argmax(fields[0]["position"][:, 2])]
    assert_equal(marcher, backend, people, pinhole(nose, (1e-4, 1e-4, -2e-4), angle=2.0))


def test_clip_planes_cut_people(marcher, backend, payload):
    fields = placed(backend)
    middle = fields["position"].mean(0)
    view = pinhole(middle, (1.0, 0.3, 3.0))
    whole = assert_equal(marcher, backend, [(payload, fields)], view)
    distance = np.linalg.norm(view.world_to_camera @ [*middle, 1])
    for clip in ((distance, 100.0), (0.01, distance)):
        cut = assert_equal(marcher, backend, [(payload, fields)], dataclasses.replace(view, clip=clip))
        assert np.abs(cut - whole).max() > 0.1


def test_parallel_views_are_as_the_backend_draws_them(marcher, backend, payload):
    fields = placed(backend)
    middle = fields["position"].mean(0)
    projection = np.diag([1.5, 1.0, -0.001, 1.0])
    to_view = np.eye(4)
    to_view[:3, :3] = BLENDER_FROM_BACKEND.T  # looks along the backend's -z
    to_view[:3, 3] = [0, -middle[1], -5.0]
    view = view_from_matrices(projection, to_view, (-50.0, 50.0), (64, 96), BLENDER_FROM_BACKEND @ middle)
    assert view.depth_offset > PARALLEL_M / 2
    assert_equal(marcher, backend, [(payload, fields)], view)


def test_a_scaled_person_is_marched_with_its_density(marcher, backend, payload):
    world = np.diag([1.3, 1.3, 1.3, 1.0])
    fields, original = placed(backend, world=world), placed(backend)
    assert np.allclose(fields["density"], original["density"] / 1.3)
    view = pinhole(fields["position"].mean(0), (0.0, 0.0, 4.0))
    whole = Boxes(fields["position"], fields["rotation"], fields["half_extent"], 1 / 1.3)
    scaled, _ = marched(marcher, [(payload, whole)], view)
    same, _ = marched(marcher, [(GpuPayload(fields["rgb"], fields["density"]), boxes_of(fields))], view)
    assert np.abs(scaled - same).max() < STEP_OF_8_BIT / 4
    assert_equal(marcher, backend, [(GpuPayload(fields["rgb"], fields["density"]), fields)], view)


def test_small_boxes_are_sampled_finely_beside_large_ones(marcher, backend, payload):
    """As the child does: half the spacing for a human of half the size, strides up to 8."""
    small, large = np.diag([0.5, 0.5, 0.5, 1.0]), np.diag([2.2, 2.2, 2.2, 1.0])
    large[0, 3] = 1.5
    fields = [placed(backend, world=world) for world in (small, large)]
    view = pinhole(np.array([0.8, 0.0, 0.0]), (0.0, 0.3, 6.0))
    people = [
        (payload, dataclasses.replace(boxes_of(one), density_scale=s))
        for one, s in zip(fields, (2, 1 / 2.2), strict=True)
    ]
    combined, _ = marched(marcher, people, view)
    camera = {"intrinsics": view.intrinsics.tolist(), "world_to_camera": view.world_to_camera.tolist()}
    boxes = [{"boxes": one["file"]} for one in fields]
    wanted, _ = backend.oracle.picture(boxes, camera, (view.width, view.height), 2 * STEP, strides=(16, 8, 4, 2, 1))
    assert np.quantile(np.abs(combined - wanted), 0.999) <= STEP_OF_8_BIT


def test_rays_end_at_other_objects(marcher, backend, payload):
    fields = placed(backend)
    middle = fields["position"].mean(0)
    view = pinhole(middle, (0.0, 0.0, 3.0), clip=(0.01, 3.05))
    people = [(payload, boxes_of(fields))]
    clipped, _ = marched(marcher, people, view)
    wall = np.full((view.height, view.width, 1), 3.05, np.float32)
    wall[: view.height // 2] = 100.0  # the bottom rows
    buffer = gpu.types.Buffer("FLOAT", wall.size, wall.ravel())
    ends = gpu.types.GPUTexture((view.width, view.height), format="R32F", data=buffer)
    free = dataclasses.replace(view, clip=(0.01, 100.0))
    ended, _ = marched(marcher, people, free, ends=ends)
    whole, _ = marched(marcher, people, free)
    half = view.height // 2
    assert np.array_equal(ended[:half], clipped[:half])
    assert np.array_equal(ended[half:], whole[half:])
    assert np.abs(clipped - whole).max() > 0.1


def test_slices_and_larger_tiles_give_the_same_picture(marcher, backend, payload, monkeypatch):
    fields = placed(backend)
    people = [(payload, boxes_of(fields))]
    view = pinhole(fields["position"].mean(0), (0.0, 0.2, 2.0), size=(75, 101))
    whole, depth = marched(marcher, people, view)
    march = marcher.march(people, view, STEP)
    part, slices = 0.3 * march._work[-1], 1
    while not march.advance(part):
        slices += 1
    assert slices > 2
    assert np.array_equal(read(march.colour, view), whole)
    monkeypatch.setattr(gpu_march, "MOST_ENTRIES", 1500)
    larger = marcher.march(people, view, STEP)
    larger.advance()
    assert larger._tile_side > gpu_march.TILE
    assert np.abs(read(larger.colour, view) - whole).max() < 1e-5
    assert np.array_equal(read(larger.depth, view), depth)


def test_coarse_pictures_show_what_the_fine_one_does(marcher, backend, payload):
    fields = placed(backend)
    people, view = [(payload, boxes_of(fields))], pinhole(fields["position"].mean(0), (1.0, 0.3, 3.0), size=(320, 480))
    fine, _ = marched(marcher, people, view)
    for coarseness in COARSENESS[:-1]:
        rows, columns = 480 // coarseness, 320 // coarseness
        mean = fine.reshape(rows, coarseness, columns, coarseness, 4).mean((1, 3))
        march = marcher.march(people, view.scaled(columns, rows), STEP * coarseness)
        march.advance()
        error = np.abs(read(march.colour, view.scaled(columns, rows)) - mean)
        inside, outside = mean[..., 3] > 0.999, mean[..., 3] == 0
        assert inside.sum() > 0.05 * inside.size
        assert error[inside].mean() < 0.05
        assert error[inside][:, 3].max() < 0.1, "no holes"
        assert error[outside].max() < 0.02


def test_nobody_and_nobody_in_view_leave_the_picture_empty(marcher, backend, payload):
    fields = placed(backend)
    view = pinhole(np.array([0.0, 0.0, 9.0]), (0.0, 0.0, -6.0))  # they are behind it
    for people in ([], [(payload, boxes_of(fields))]):
        combined, depth = marched(marcher, people, view)
        assert not combined.any()
        assert (depth >= NO_SURFACE_M).all()
