"""Pictures of people among solids: against the slow marcher with spans found by hand."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from march_scenes import camera_at, one_box, random_boxes
from primdiffusion.drawing import (
    FIRST_PIXELS,
    GROWTH,
    NOTHING,
    Scene,
    ViewSettings,
    depth_span,
    draw,
    draw_in_bands,
)
from primdiffusion.geometry.camera import Camera
from primdiffusion.geometry.image import Image, encode_srgb
from primdiffusion.primitives.primitives import Primitives
from primdiffusion.raster.z_buffer import nearest_triangles
from primdiffusion.render.image import depth_colours
from primdiffusion.render.lattice import MarchSettings, Span
from primdiffusion.render.reference import march_reference
from primdiffusion.render.solids import Solids, draw_boxes, shade_solids
from support.errors import refused

RED = (0.8, 0.1, 0.1)
BACKGROUND = (0.1, 0.3, 0.6)
SETTINGS = MarchSettings(step=0.001, strides=(1,))


def wall(z: float, slope: float = 0.0, holdout: bool = False) -> Solids:
    """The plane z + slope * x, 40 m wide, which reaches behind any camera here where it slopes."""
    corners = np.array([[x, y, z + slope * x] for x, y in ((-20, -20), (20, -20), (20, 20), (-20, 20))], np.float32)
    return Solids(corners[[[0, 1, 2], [0, 2, 3]]], np.array([RED] * 2, np.float32), np.full(2, holdout))


@pytest.fixture
def boxes() -> Primitives:
    return random_boxes(14, 3, spread=0.05, density=60.0).to(dtype=torch.float32)


@pytest.fixture
def camera() -> Camera:
    return camera_at((0.1, 0.15, 0.6), fov=0.5, width=36, height=28).to(dtype=torch.float32)


def geometry(camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Origin, unit rays, and their cosine with the optical axis, float64."""
    origin, rays = (value.numpy() for value in camera.to(dtype=torch.float64).rays())
    return origin, rays, rays @ camera.world_to_camera[2, :3].double().numpy()


def slow(boxes: Primitives, camera: Camera, near: np.ndarray, far: np.ndarray):
    span = Span(torch.from_numpy(near.copy()), torch.from_numpy(far.copy()))
    return march_reference(boxes.to(dtype=torch.float64), camera.to(dtype=torch.float64), SETTINGS, span)


@pytest.mark.parametrize(("z", "slope"), [(-0.03, 0.0), (0.0, 0.4), (0.02, -3.0)])
def test_a_solid_through_people_hides_exactly_what_is_behind_it(boxes, camera, z, slope):
    origin, rays, cosine = geometry(camera)
    normal = np.array([-slope, 0.0, 1.0])
    far = (z - origin @ normal) / (rays @ normal)
    far[far < 0] = np.inf
    people = slow(boxes, camera, np.zeros_like(far), far)
    solids = wall(z, slope)
    shaded = shade_solids(solids, nearest_triangles(solids.corners, camera), camera)
    behind = np.where(np.isfinite(far)[..., None], shaded.rgb, BACKGROUND)
    want = people.rgb.numpy() + (1 - people.alpha.numpy())[..., None] * behind

    got = draw(Scene(boxes, solids), camera, ViewSettings(background=BACKGROUND, settings=SETTINGS))
    free = draw(Scene(boxes), camera, ViewSettings(background=BACKGROUND, settings=SETTINGS))
    assert np.abs(free.rgb - want).max() > 0.2, "the solid matters"
    error = np.abs(got.rgb - want).max(-1)
    assert error.max() < 0.07, "a sample on the very surface may fall to either side"
    assert np.quantile(error, 0.98) < 1e-3
    assert np.allclose(got.alpha, 1, atol=1e-6)
    depth = np.minimum(people.first_hit.numpy(), far) * cosine
    assert np.quantile(np.abs(got.depth - np.where(np.isfinite(depth), depth, NOTHING)), 0.98) < 1e-5


def test_clip_planes_are_at_depths_and_not_at_distances(boxes, camera):
    _, _, cosine = geometry(camera)
    start, end = 0.61, 0.65
    want = slow(boxes, camera, start / cosine, end / cosine)
    got = draw(Scene(boxes), camera, ViewSettings(clip=(start, end), settings=SETTINGS))
    error = np.abs(got.alpha - want.alpha.numpy())
    assert error.max() < 0.07
    assert np.quantile(error, 0.98) < 1e-3
    assert 0.05 < want.alpha.mean() < draw(Scene(boxes), camera, ViewSettings()).alpha.mean() - 0.02
    distances = slow(boxes, camera, np.full_like(cosine, start), np.full_like(cosine, end))
    assert np.abs(distances.alpha - want.alpha).max() > 0.1, "the test can tell them apart"


def test_all_boxes_lie_within_the_depth_span_and_touch_its_ends(boxes, camera):
    signs = torch.cartesian_prod(*[torch.tensor([-1.0, 1.0])] * 3)
    corners = boxes.position[:, None] + (boxes.half_extent[:, None] * signs) @ boxes.rotation.mT
    _, depth = camera.project(corners.reshape(-1, 3))
    assert depth_span(boxes, camera, (0, math.inf)) == pytest.approx((float(depth.min()), float(depth.max())))
    assert depth_span(boxes, camera, (0.55, 0.6)) == (0.55, 0.6)


def test_a_solids_outline_is_smooth_and_where_it_is_nearer_it_hides_people(boxes, camera):
    """A wall whose edge crosses the picture at a slant, before the people and behind them."""
    for z in (0.3, -0.3):
        corners = np.array([[[-9, -9, z], [3, -9, z], [-3, 9, z]], [[-9, -9, z], [-3, 9, z], [-9, 9, z]]])
        corners += [0.1 * z / 0.6, 0.15 * z / 0.6, 0.0]  # so that the edge passes through the middle of the picture
        half = Solids(corners.astype(np.float32), np.array([RED] * 2, np.float32), np.zeros(2, bool))
        alone = draw(Scene(None, half), camera).rgba
        covered = alone[..., 3]
        assert set(np.unique(covered)) == {0.0, 0.25, 0.5, 0.75, 1.0}
        people = draw(Scene(boxes), camera).rgba
        got = draw(Scene(boxes, half), camera).rgba
        over = people + (1 - people[..., 3:]) * alone
        under = alone + (1 - covered[..., None]) * people
        assert np.abs(over - under).max() > 0.1
        assert np.allclose(got, under if z > 0 else over, atol=1e-5)
        depth = draw(Scene(None, half), camera).depth
        assert np.array_equal(depth < NOTHING, covered >= 0.5)


def test_far_and_narrow_views_find_outlines_too(boxes):
    """From 2 km, as parallel views are taken: a wall whose edge has people and another wall behind it."""
    camera = camera_at((0.0, 0.0, 2000.0), fov=0.15 / 1000, width=36, height=36).to(dtype=torch.float32)
    corners = np.array([[[-9, -9, 0.3], [3, -9, 0.3], [-3, 9, 0.3]], [[-9, -9, 0.3], [-3, 9, 0.3], [-9, 9, 0.3]]])
    half = Solids(corners.astype(np.float32), np.array([RED] * 2, np.float32), np.zeros(2, bool))
    far = wall(-0.3)
    both = Solids(*(np.concatenate([getattr(half, n), getattr(far, n)]) for n in ("corners", "colour", "holdout")))
    people_before_far, near = draw(Scene(boxes, far), camera).rgba, draw(Scene(None, half), camera).rgba
    want = near + (1 - near[..., 3:]) * people_before_far
    outline = (near[..., 3] > 0) & (near[..., 3] < 1)
    assert (np.abs(want - draw(Scene(None, both), camera).rgba).max(-1) > 0.1)[outline].any(), "people are there"
    assert np.allclose(draw(Scene(boxes, both), camera).rgba, want, atol=1e-4)


def test_without_a_background_the_picture_is_premultiplied_and_transparent(boxes, camera):
    clear, full = draw(Scene(boxes), camera), draw(Scene(boxes), camera, ViewSettings(background=BACKGROUND))
    alpha = clear.rgba[..., 3:]
    assert alpha.min() == 0
    assert np.allclose(full.rgb, clear.rgb + (1 - alpha) * BACKGROUND, atol=1e-6)
    assert (clear.rgba[alpha[..., 0] == 0] == 0).all()
    assert (clear.depth[alpha[..., 0] < 0.5] == np.float32(NOTHING)).all()


def test_a_holdout_leaves_a_hole_in_all_but_what_is_before_it(boxes, camera):
    held = draw(Scene(boxes, wall(0.0, holdout=True)), camera, ViewSettings(background=BACKGROUND))
    kept = draw(Scene(boxes, wall(0.0)), camera)
    solid = draw(Scene(None, wall(0.0)), camera)
    alpha = (kept.rgb - held.rgb) / solid.rgb
    assert np.allclose(held.alpha, 1 - alpha.mean(-1), atol=1e-4), "what is not a person is a hole"
    assert 0.1 < held.alpha.mean() < 0.9
    no_human = draw(Scene(None, wall(0.0, holdout=True)), camera, ViewSettings(background=BACKGROUND))
    assert (no_human.rgba == 0).all()
    assert (no_human.depth == np.float32(NOTHING)).all()


def test_the_view_depth_shows_expected_depth_in_colours(boxes, camera):
    _, _, cosine = geometry(camera)
    free = np.zeros_like(cosine)
    people = slow(boxes, camera, free, free + np.inf)
    span = depth_span(boxes, camera, (0, math.inf))
    solid = people.alpha.numpy() > 0.999
    got = draw(Scene(boxes), camera, ViewSettings("depth", settings=SETTINGS)).rgba[solid]
    want = depth_colours(people.depth.numpy() * cosine, *span)[solid]
    assert np.abs(encode_srgb(got[:, :3]) - want).max() < 0.01
    assert len(got) > 50
    with_wall = draw(Scene(boxes, wall(0.5)), camera, ViewSettings("depth"))
    assert np.allclose(encode_srgb(with_wall.rgb), depth_colours(np.zeros(()), *span), atol=1e-5)


def test_the_view_alpha_shows_coverage_by_people_that_solids_do_not_hide(boxes, camera):
    people = draw(Scene(boxes), camera).alpha
    got = draw(Scene(boxes, wall(-0.4)), camera, ViewSettings("alpha", background=BACKGROUND)).rgba
    assert np.allclose(encode_srgb(got[..., :3]), people[..., None], atol=1e-5)
    assert (got[..., 3] == 1).all()
    hidden = draw(Scene(boxes, wall(0.4)), camera, ViewSettings("alpha")).rgba
    assert (hidden[..., :3] == 0).all()


def test_the_view_boxes_shows_boxes_before_solids(boxes, camera):
    drawn = draw_boxes(boxes, camera)
    got = draw(Scene(boxes, wall(-0.4)), camera, ViewSettings("boxes"))
    seen = drawn.alpha > 0
    assert 0.1 < seen.mean() < 0.9
    assert np.array_equal(got.rgba[seen, :3], drawn.rgb[seen])
    assert np.array_equal(got.depth[seen], drawn.depth[seen])
    assert np.allclose(got.rgba[~seen], draw(Scene(None, wall(-0.4)), camera).rgba[~seen])
    through = draw(Scene(boxes, wall(0.0)), camera, ViewSettings("boxes"))
    wall_depth = draw(Scene(None, wall(0.0)), camera).depth
    assert np.array_equal(through.depth, np.minimum(np.where(seen, drawn.depth, np.inf), wall_depth))


@pytest.mark.parametrize(
    ("view", "speed"),
    [("colour", None), ("colour", 1.0), ("depth", 1e9), ("depth", 2000.0), ("alpha", 2000.0), ("boxes", 2000.0)],
)
def test_bands_make_the_picture(boxes, camera, view, speed):
    scene, look = Scene(boxes, wall(0.0, 0.4)), ViewSettings(view, BACKGROUND, (0.1, 10))
    whole, picture = draw(scene, camera, look), Image.blank(camera.width, camera.height)
    picture.rgb[:] = picture.alpha[:] = np.nan
    rows = [done.rows for done in draw_in_bands(picture, scene, camera, look, speed)]
    assert rows[-1] == camera.height
    assert np.quantile(np.abs(picture.rgba - whole.rgba), 0.99) < 1e-4
    assert np.quantile(np.abs(picture.depth - whole.depth), 0.99) < 1e-5
    if speed == 1.0:
        assert rows[0] == 1, "a band has a row at least"
        assert all(b - a <= GROWTH * max(a - c, 1) for c, a, b in zip([0, *rows], rows, rows[1:], strict=False))
    if speed == 1e9:
        assert rows == [camera.height], "what is quickly done is done at once"


def test_the_first_band_of_an_unknown_machine_is_small():
    camera = camera_at((0.0, 0.0, 1.0), width=1024, height=512).to(dtype=torch.float32)
    picture = Image.blank(1024, 512)
    bands = draw_in_bands(picture, Scene(None), camera, ViewSettings())
    assert next(bands).rows == FIRST_PIXELS // 1024


def test_an_empty_scene_is_the_background(camera):
    no_boxes = dataclasses.replace(one_box(), **{k: v[:0] for k, v in vars(one_box()).items()}).to(dtype=torch.float32)
    for scene in (Scene(None), Scene(no_boxes)):
        for view in ("colour", "depth", "boxes"):
            picture = draw(scene, camera, ViewSettings(view, BACKGROUND))
            assert np.allclose(picture.rgba, (*BACKGROUND, 1), atol=1e-6)
            assert (picture.depth == np.float32(NOTHING)).all()


@pytest.mark.parametrize(
    "wrong", [{"view": "x-ray"}, {"clip": (2.0, 1.0)}, {"clip": (-1.0, 1.0)}, {"clip": (1, math.nan)}]
)
def test_unknown_views_and_impossible_planes_are_rejected(wrong):
    with refused(ValueError, wrong.get("view", "clip")):
        ViewSettings(**wrong)
