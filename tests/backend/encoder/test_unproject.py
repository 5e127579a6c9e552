"""Looking people up in pictures: plates by hand, bodies against a slow twin, and a box that the marcher drew."""

import math

import numpy as np
import pytest
import torch
from primdiffusion.body.model import BodyModel, BodyPose, J, default_body
from primdiffusion.capture.dataset import stack
from primdiffusion.capture.reader import Views
from primdiffusion.encoder.unproject import (
    COVERED,
    HULL_MARGIN,
    SIDE,
    TOLERANCE,
    Unprojected,
    extents_of_hull,
    unproject_texels,
    unproject_voxels,
)
from primdiffusion.geometry.camera import Camera, look_at
from primdiffusion.geometry.image import encode_srgb
from primdiffusion.geometry.surface import surface_points, vertex_normals
from primdiffusion.primitives.anchors import attach, default_anchors, default_texels
from primdiffusion.primitives.primitives import GRID, Frames, K, Payload, Primitives, S
from primdiffusion.raster.z_buffer import nearest_triangles
from primdiffusion.render.march import march
from support.errors import refused

BODY = default_body()
ONES = torch.ones(K, 3)
RED, BLUE = (255, 0, 0, 255), (0, 0, 255, 255)


def plates(*depths: float, uv_width: float = 1.0) -> BodyModel:
    """Unit squares that face +z at these z, one behind the other; their UV charts share `uv_width` of the square."""
    corners = torch.tensor([[0.0, 0], [1, 0], [1, 1], [0, 1]])
    vertices = torch.cat([torch.cat([corners - 0.5, torch.full((4, 1), z)], 1) for z in depths])
    uv = torch.cat([(corners + torch.tensor([i, 0])) * torch.tensor([uv_width, 1]) for i in range(len(depths))])
    uv[:, 0] /= len(depths)
    faces = torch.cat([torch.tensor([[0, 1, 2], [0, 2, 3]]) + 4 * i for i in range(len(depths))])
    count = len(vertices)
    return BodyModel(
        template=vertices,
        shape_basis=torch.zeros(count, 3, 1),
        pose_basis=torch.zeros(count, 3, 0),
        joint_regressor=torch.full((J, count), 1 / count),
        skin_weights=torch.full((count, J), 1 / J),
        parents=torch.tensor([-1] + [0] * (J - 1)),
        faces=faces,
        uv=uv,
        uv_faces=faces,
    )


def filling(z: float, pixels: int, distance: float = 10.0) -> Camera:
    """A camera on +z whose picture is filled by the unit square at `z`."""
    fov = 2 * math.atan(0.5 / (distance - z))
    return look_at(torch.tensor([0.0, 0, distance]), torch.zeros(3), vertical_fov=fov, width=pixels, height=pixels)


def views_of(pictures, cameras) -> Views:
    pictures = torch.as_tensor(np.asarray(pictures), dtype=torch.uint8)
    return Views(pictures, stack(list(cameras)), BodyPose.rest())


def plain(colour, pixels: int = 16) -> np.ndarray:
    return np.broadcast_to(np.array(colour, np.uint8), (pixels, pixels, 4))


def noise(*shape: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, shape).astype(np.uint8)


def opaque(picture: np.ndarray) -> np.ndarray:
    return np.concatenate([picture[..., :3], np.full_like(picture[..., :1], 255)], -1)


def test_row_0_is_v_0_and_texels_meet_pixels_centre_to_centre():
    body, picture = plates(0.0), opaque(noise(SIDE, SIDE, 4))
    found = unproject_texels(views_of([picture], [filling(0, SIDE)]), body.template, 0, body)
    # Pixels' rows run down, v runs up; on the outermost texels rounding decides whether they are inside the picture.
    inner = slice(1, -1)
    assert torch.equal(
        found.rgb[0, :, inner, inner].movedim(0, -1), torch.tensor(picture[::-1, :, :3].copy())[1:-1, 1:-1]
    )
    assert (found.seen[0, inner, inner] == 255).all()
    assert (found.covered[0, inner, inner] == 255).all()


def test_sampling_is_bilinear():
    body, picture = plates(0.0), opaque(noise(SIDE // 2, SIDE // 2, 4))
    found = unproject_texels(views_of([picture], [filling(0, SIDE // 2)]), body.template, 0, body)
    wanted = torch.tensor(picture[..., :3]).movedim(-1, 0).float().flip(1)
    wanted = torch.nn.functional.interpolate(wanted[None], scale_factor=2, mode="bilinear")[0]
    assert (found.rgb[0].float() - wanted)[:, 1:-1, 1:-1].abs().max() <= 0.51


@pytest.mark.parametrize(("gap", "seen"), [(0.018, 255), (0.022, 0)])
def test_a_surface_hides_what_lies_more_than_2_cm_behind_it(gap, seen):
    body = plates(0.0, gap)
    found = unproject_texels(views_of([plain(RED)], [filling(gap, 16)]), body.template, 0, body)
    behind, front = found.seen[0, 8:-8, 8:120], found.seen[0, 8:-8, 136:-8]
    assert (front == 255).all()
    assert (behind == seen).all()


def test_texels_outside_every_chart_are_not_visible():
    body = plates(0.0, uv_width=0.5)
    found = unproject_texels(views_of([plain(RED)], [filling(0, 16)]), body.template, 0, body)
    assert (found.seen[..., 1:-1, 1:127] == 255).all()
    outside = found.map(lambda tensor: tensor[..., 128:])
    assert not outside.seen.any()
    assert not outside.rgb.any()
    assert (outside.covered == 255).all()


@pytest.mark.parametrize(("mask", "seen"), [(127, 0), (128, 128), (200, 200), (255, 255)])
def test_half_covered_pixels_count_by_their_mask_and_less_covered_ones_not_at_all(mask, seen):
    body = plates(0.0)
    found = unproject_texels(views_of([plain((90, 80, 70, mask))], [filling(0, 16)]), body.template, 0, body)
    assert found.seen[0, 128, 128].item() == seen
    assert found.covered[0, 128, 128].item() == mask
    assert found.rgb[0, :, 128, 128].tolist() == ([90, 80, 70] if seen else [0, 0, 0])


@pytest.mark.parametrize("facing", [0, 1, 2])
def test_views_count_by_their_cosine_to_the_power(facing):
    body, distance, angle = plates(0.0), 5.0, math.radians(60)
    aside = torch.tensor([distance * math.sin(angle), 0, distance * math.cos(angle)])
    cameras = [filling(0, 128), look_at(aside, torch.zeros(3), vertical_fov=0.5, width=128, height=128)]
    found = unproject_texels(views_of([plain(RED, 128), plain(BLUE, 128)], cameras), body.template, facing, body)
    share = 1 / (1 + math.cos(angle) ** facing)
    assert found.rgb[0, :, 128, 128].float().tolist() == pytest.approx([255 * share, 0, 255 * (1 - share)], abs=1.5)


def away(camera: Camera) -> Camera:
    """Turned by half a turn where it stands: what was in front is behind it."""
    turn = torch.diag(torch.tensor([-1.0, 1, -1]))
    return Camera(camera.intrinsics, turn @ camera.world_to_camera, camera.width, camera.height)


def beside(camera: Camera) -> Camera:
    """The same view with the person out of the picture."""
    return camera.moved_in_picture(10.0 * camera.width, 0.0)


@pytest.mark.parametrize("moved", [away, beside])
def test_views_that_do_not_show_the_person_say_nothing(moved):
    body, camera = plates(0.0), filling(0, 16)
    pictures = [opaque(noise(16, 16, 4, seed=i)) for i in range(2)]
    alone = unproject_texels(views_of(pictures[:1], [camera]), body.template, 2, body)
    both = unproject_texels(views_of(pictures, [camera, moved(camera)]), body.template, 2, body)
    assert all(torch.equal(a, b) for a, b in zip(vars(alone).values(), vars(both).values(), strict=True))
    nothing = unproject_texels(views_of(pictures[1:], [moved(camera)]), body.template, 2, body)
    assert not nothing.rgb.any()
    assert not nothing.seen.any()
    assert (nothing.covered == 255).all()


# Bodies.

POSED = BODY.shape(torch.linspace(-1, 1, 10)).pose(BodyPose.rest()).vertices
FRAMES = attach(default_anchors(), POSED, BODY.faces)


def body_camera(yaw: float, pixels: int = 40, distance: float = 3.0, height: float = 0.2) -> Camera:
    middle = POSED.mean(0)
    position = middle + distance * torch.tensor([math.sin(yaw), height, math.cos(yaw)])
    return look_at(position, middle, vertical_fov=0.8, width=pixels, height=pixels)


def person_views() -> Views:
    """Noise around a person, one camera so near that much lies outside its picture and behind it, one turned away."""
    cameras = [body_camera(0.3), body_camera(2.5), body_camera(-1.0, distance=0.3), away(body_camera(1.0))]
    pictures = noise(4, 40, 40, 4)
    pictures[..., 3] = np.where(pictures[..., 3] < 60, pictures[..., 3], 255)
    return views_of(pictures, cameras)


def silhouettes(vertices: torch.Tensor, cameras) -> Views:
    """White pictures whose masks are those of a body."""
    corners = vertices[BODY.faces].double().numpy()
    inside = [np.isfinite(nearest_triangles(corners, camera).depth) for camera in cameras]
    return views_of(np.stack([np.repeat(255 * mask[..., None], 4, -1) for mask in inside]).astype(np.uint8), cameras)


def twin(point, normal, views: Views, depths, facing: int):
    """What `unproject` finds at one point, in float64 (SPEC 2); None where rounding could turn a decision."""
    total, possible, colour, least = 0.0, 0.0, np.zeros(3), 255.0
    for view, picture in enumerate(views.rgba.numpy().astype(np.float64)):
        camera = views.camera.map(lambda tensor, view=view: tensor[view]).to(dtype=torch.float64)
        pixel, depth = camera.project(torch.as_tensor(point))
        (u, v), depth = pixel.tolist(), depth.item()
        size = len(picture)
        if min(abs(depth - 1e-3), *(abs(edge - at) for edge in (0, size) for at in (u, v))) < 1e-3:
            return None
        if depth < 1e-3 or not (0 <= u < size and 0 <= v < size):
            continue
        to_camera = camera.position.numpy() - point
        cosine = max(normal @ to_camera / np.linalg.norm(to_camera), 0.02)
        possible += cosine**facing
        value = np.zeros(4)
        for row in (math.floor(v - 0.5), math.floor(v - 0.5) + 1):
            for column in (math.floor(u - 0.5), math.floor(u - 0.5) + 1):
                weight = (1 - abs(v - 0.5 - row)) * (1 - abs(u - 0.5 - column))
                value += weight * picture[min(max(row, 0), size - 1), min(max(column, 0), size - 1)]
        least = min(least, value[3])
        behind = depth - depths[view][int(v), int(u)] - TOLERANCE
        near_an_edge = min(u % 1, 1 - u % 1, v % 1, 1 - v % 1) < 1e-3
        if abs(behind) < 1e-4 or abs(value[3] - COVERED) < 1e-2 or near_an_edge:
            return None
        if behind > 0 or value[3] < COVERED:
            continue
        total += cosine**facing * value[3] / 255
        colour += cosine**facing * value[3] / 255 * value[:3]
    return (colour / total if total else colour), (255 * total / possible if possible else 0.0), least


def agrees_with_the_twin(found, places, points, normals, views: Views, facing: int) -> int:
    """Compares points; how many of them some view sees."""
    corners = POSED[BODY.faces].double().numpy()
    depths = [
        nearest_triangles(corners, views.camera.map(lambda tensor, view=view: tensor[view])).depth
        for view in range(len(views.rgba))
    ]
    lit = compared = 0
    for place, point, normal in zip(places, points.double().numpy(), normals.double().numpy(), strict=True):
        expected = twin(point, normal, views, depths, facing)
        if expected is None:
            continue
        d, row, column = place
        compared += 1
        lit += expected[1] > 0
        # float32 moves pixels by 1e-4; noise turns that into less than half a level more than rounding's half.
        assert found.rgb[d, :, row, column].numpy() == pytest.approx(expected[0], abs=1.0)
        assert found.seen[d, row, column].item() == pytest.approx(expected[1], abs=1.01)
        assert found.covered[d, row, column].item() == pytest.approx(expected[2], abs=0.6)
    assert compared > 0.8 * len(points)
    return lit


@pytest.mark.parametrize("facing", [0, 2])
def test_texels_are_those_of_the_slow_twin(facing):
    views = person_views()
    found = unproject_texels(views, POSED, facing)
    draws = np.random.default_rng(1)
    rows, columns = torch.from_numpy(draws.integers(0, SIDE, (2, 250)))
    face, barycentric = (tensor[rows, columns] for tensor in default_texels())
    points = surface_points(POSED, BODY.faces, face, barycentric)
    normals = surface_points(vertex_normals(POSED, BODY.faces), BODY.faces, face, barycentric)
    places = [(0, row, column) for row, column in zip(rows.tolist(), columns.tolist(), strict=True)]
    assert agrees_with_the_twin(found, places, points, normals, views, facing) > 80


def test_voxels_are_those_of_the_slow_twin_in_the_payloads_order():
    views = person_views()
    found = unproject_voxels(views, POSED, FRAMES, ONES, 2)
    draws = np.random.default_rng(2)
    k, d, h, w = np.concatenate([draws.integers(0, K, (1, 250)), draws.integers(0, S, (3, 250))])
    local = torch.from_numpy(np.stack([w, h, d], -1) / (S - 1) * 2 - 1).float()
    points = FRAMES.position[k] + (FRAMES.rotation[k] @ (FRAMES.half_extent[k] * local)[..., None])[..., 0]
    places = list(zip(d.tolist(), (k // GRID * S + h).tolist(), (k % GRID * S + w).tolist(), strict=True))
    assert agrees_with_the_twin(found, places, points, FRAMES.rotation[k, :, 2], views, 2) > 80


def test_what_the_marcher_draws_of_a_voxel_is_found_at_this_voxel():
    chest = int((FRAMES.position - torch.tensor([0.08, 0.25, 0.2])).norm(dim=-1).argmin())
    density = torch.zeros(K, S, S, S)
    density[chest] = 2000
    rgb = torch.zeros(K, 3, S, S, S)
    ramp = torch.linspace(0.1, 1, S)
    rgb[chest, 0], rgb[chest, 1] = ramp[:, None].expand(S, S, S), ramp.expand(S, S, S)  # red along H, green along W
    normal = FRAMES.rotation[chest, :, 2]
    camera = look_at(FRAMES.position[chest] + 2 * normal, FRAMES.position[chest], vertical_fov=0.1, width=96, height=96)
    picture = march(Primitives.place(FRAMES, Payload(rgb, density, torch.ones(K, 3))), camera)
    rgba = torch.cat([encode_srgb(picture.rgb), picture.alpha[..., None]], -1).clamp(0, 1).mul(255).round()
    found = unproject_voxels(views_of(rgba[None], [camera]), POSED, FRAMES, ONES, 2)
    ny, nx, inner = chest // GRID, chest % GRID, slice(1, S - 1)
    cell = found.rgb[S - 1, :, ny * S : (ny + 1) * S, nx * S : (nx + 1) * S].float() / 255
    wanted = encode_srgb(rgb[chest, :, S - 1])
    # A level of the ramp is 0.06 or more apart; perspective and the marcher's interpolation move them by a third of it.
    assert (cell - wanted)[:, inner, inner].abs().max() < 0.03


def test_boxes_are_as_thick_as_the_masks_hull():
    covered = torch.zeros(S, GRID, S, GRID, S, dtype=torch.uint8)
    covered[:, 0, :, 0] = 255  # a box inside a skirt
    covered[:5, 0, :, 1] = 255  # skin, somewhat in front of the middle
    covered[:7, 0, :, 2] = 255  # cloth
    covered[:, 0, 0, 3] = 255  # only an outer row, which is the neighbour's
    blank = torch.zeros(S, SIDE, SIDE, dtype=torch.uint8)
    found = Unprojected(blank[:, None].expand(-1, 3, -1, -1), blank, covered.flatten(1, 2).flatten(2), ONES)
    extent = extents_of_hull(found, (0.85, 0.85, 0.45))
    assert torch.allclose(extent[:5, 2], torch.tensor([1, 0.45, 5 / 7 + HULL_MARGIN, 0.45, 0.45]))
    assert (extent[:, :2] == 0.85).all()


def test_a_persons_boxes_contain_the_hull_of_the_masks():
    """Of a body that is 4 cm thicker than that which carries the boxes, as in loose clothes."""
    vertices = POSED + 0.04 * vertex_normals(POSED, BODY.faces)
    cameras = [body_camera(angle, 160) for angle in (0.0, math.pi / 2, math.pi, -math.pi / 2)]
    found = unproject_voxels(silhouettes(vertices, cameras), POSED, FRAMES, ONES, 2)
    thin = unproject_voxels(silhouettes(POSED, cameras), POSED, FRAMES, ONES, 2)
    thicker, exact = (extents_of_hull(views, (0.85, 0.85, 0.45))[:, 2] for views in (found, thin))
    assert (thicker >= exact).all()
    assert thicker.mean() > exact.mean() + 0.2


# What is rejected.


def assert_rejected(
    message: str, views: Views | None = None, vertices=POSED, frames: Frames | None = None, body=None
) -> None:
    views = person_views() if views is None else views
    unproject_views = (lambda: unproject_texels(views, vertices, 2, body)) if frames is None else (
        lambda: unproject_voxels(views, vertices, frames, ONES, 2)
    )  # fmt: skip
    with refused(ValueError, message):
        unproject_views()


def test_views_that_are_none_batched_or_no_bytes_are_rejected():
    views = person_views()
    assert_rejected("uint8 [v, H, W, 4], v > 0", Views(views.rgba[:0], views.camera, views.pose))
    assert_rejected("(1, 4, 40, 40, 4): give one human's", Views(views.rgba[None], views.camera, views.pose))
    assert_rejected("torch.float32", Views(views.rgba / 255, views.camera, views.pose))


def test_cameras_that_do_not_go_with_the_pictures_are_rejected():
    views = person_views()
    assert_rejected("40 x 20 pixels, but their cameras 40 x 40", Views(views.rgba[:, :20], views.camera, views.pose))
    assert_rejected("give one for each picture", Views(views.rgba[:2], views.camera, views.pose))


def test_bodies_that_are_broken_or_others_are_rejected():
    assert_rejected("NaN", vertices=POSED * torch.nan)
    assert_rejected("of the same body", vertices=POSED[:-1])
    assert_rejected("of the same body", vertices=POSED[None])
    assert_rejected(
        "no UV", vertices=plates(0.0).template, body=BodyModel(**{**vars(plates(0.0)), "uv": torch.zeros(0, 2)})
    )
    assert_rejected("give one human's 1024", frames=FRAMES.map(lambda tensor: tensor[:5]))
