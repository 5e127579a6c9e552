"""Whole people: these need a MakeHuman asset folder and skip without one."""

import dataclasses
import json

import numpy as np
import pytest
import torch
import trimesh
from primdiffusion.diffusion.checkpoint import load_checkpoint
from primdiffusion.geometry.image import encode_srgb
from primdiffusion.people import assets as assets_module
from primdiffusion.people import garments
from primdiffusion.people import payloads as payloads_module
from primdiffusion.people import person as person_module
from primdiffusion.people.appearance import SkinColours, skin_texture
from primdiffusion.people.assets import ENVIRONMENT_VARIABLE, open_assets, parse_mhclo
from primdiffusion.people.base_mesh import load_base_mesh
from primdiffusion.people.colours import lab_from_bytes
from primdiffusion.people.fitting import shown_faces, skin_under_hem, skirt_faces, under_hat
from primdiffusion.people.payloads import fitted_payloads, is_complete, make_payloads, orbit_camera, rest_frames
from primdiffusion.people.person import make_person, recolour
from primdiffusion.people.wardrobe import HAIR, HATS, OUTFITS, choose, draw_body
from primdiffusion.primitives.from_mesh import FULL_DENSITY, from_mesh
from primdiffusion.primitives.primitives import Payload, Primitives
from primdiffusion.raster.rasterise import rasterise
from primdiffusion.render.inverse import InverseSettings
from primdiffusion.render.march import march
from scipy.ndimage import binary_erosion, gaussian_filter
from support.errors import refused

SEEDS = range(4)


@pytest.fixture(scope="module")
def base():
    return load_base_mesh()


@pytest.fixture(scope="module")
def people(assets, base):
    return [make_person(assets, base, seed) for seed in SEEDS]


def shaded_top(assets, base, name):
    """A garment's cloth, and the texels of its top."""
    garment = next(each for each in OUTFITS["female"] if each.name == name)
    fabric = garments.cloth(assets, base, garment)
    return fabric, fabric.piece == [piece.kind for piece in garment.pieces].index("top")


@pytest.mark.parametrize("name", ["female_casualsuit01", "male_casualsuit02", "male_casualsuit04"])
def test_tops_have_no_lettering(assets, base, name):
    fabric, top = shaded_top(assets, base, name)
    detail = np.abs(fabric.shade - gaussian_filter(fabric.shade, 6))[binary_erosion(top, iterations=12)]
    assert np.quantile(detail, 0.99) < 0.12
    assert not fabric.trim[top].any()


@pytest.mark.parametrize("name", ["male_casualsuit03", "female_elegantsuit01"])
def test_striped_tops_have_no_bright_spots(assets, base, name):
    fabric, top = shaded_top(assets, base, name)
    assert np.quantile(fabric.shade[top], 0.99) < 1.3


def test_the_tie_of_a_suit_is_plain(assets, base):
    garment = next(each for each in OUTFITS["male"] if each.name == "male_elegantsuit01")
    fabric = garments.cloth(assets, base, garment)
    tie = (lab_from_bytes(fabric.original[..., :3])[..., 2] < -10) & (fabric.piece == 0)
    assert tie.sum() > 100  # blue in the pack, on a grey suit with a white shirt
    assert fabric.trim[tie].mean() < 0.02
    assert fabric.shade[tie].std() < 0.1 < fabric.shade[fabric.trim].std()


def same_pictures(first, second):
    return all(np.array_equal(a.texture, b.texture) for a, b in zip(first.mesh.parts, second.mesh.parts, strict=True))


def test_no_folder_says_how_to_name_one_and_an_absent_one_is_named(monkeypatch, tmp_path):
    monkeypatch.delenv(ENVIRONMENT_VARIABLE, raising=False)
    with refused(FileNotFoundError, "--assets", ENVIRONMENT_VARIABLE):
        open_assets()
    with refused(FileNotFoundError, "nowhere"):
        open_assets(tmp_path / "nowhere")


def test_incomplete_folder_says_what_it_lacks(tmp_path):
    for name in assets_module.SUBFOLDERS:
        (tmp_path / name).mkdir()
    assert open_assets(tmp_path).root == tmp_path.resolve()
    with refused(FileNotFoundError, "eyes/low-poly/low-poly.mhclo"):
        open_assets(tmp_path, ("eyes/low-poly/low-poly",))
    (tmp_path / "skins").rmdir()
    with refused(FileNotFoundError):
        open_assets(tmp_path)


def test_environment_names_the_folder(tmp_path, monkeypatch):
    for name in assets_module.SUBFOLDERS:
        (tmp_path / name).mkdir()
    monkeypatch.setenv(ENVIRONMENT_VARIABLE, str(tmp_path))
    assert open_assets().root == tmp_path.resolve()


def test_pointers_left_by_git_lfs_are_not_pictures(tmp_path):
    for name in assets_module.SUBFOLDERS:
        (tmp_path / name).mkdir()
    (tmp_path / "eyes" / "iris.png").write_text("version https://git-lfs.github.com/spec/v1\n")
    assert not open_assets(tmp_path).has_picture("eyes/iris")


def test_outer_clothes_hide_the_body_and_what_lies_deeper(base):
    triangle = base.faces[0]
    line = "{} {} {} 1 0 0 0 0 0\n".format(*triangle)
    listed = " ".join(str(vertex) for vertex in triangle)
    outer = parse_mhclo(f"name outer\nz_depth 50\nverts 0\n{line * 3}delete_verts\n{listed}\n")
    inner = parse_mhclo(f"name inner\nz_depth 5\nverts 0\n{line * 3}")
    proxies = {"inner": (inner, np.array([[0, 1, 2]])), "outer": (outer, np.array([[0, 1, 2]]))}
    shown = shown_faces(base, proxies, np.zeros(len(base.template), bool))
    assert not shown["body"][0]
    assert shown["body"].sum() == len(base.faces) - 1
    assert not shown["inner"].any()
    assert shown["outer"].all()


def test_hat_covers_hair_above_its_tilted_brim():
    angle = np.linspace(0, 2 * np.pi, 60, endpoint=False)
    brim = np.stack([0.2 * np.cos(angle), 1 + 0.1 * np.cos(angle), 0.2 * np.sin(angle)], -1)
    crown = np.stack([0.1 * np.cos(angle), 1.2 + 0 * angle, 0.1 * np.sin(angle)], -1)
    hair = np.array([[0.15, 1.1, 0.0], [0.15, 1.05, 0.0], [-0.15, 0.95, 0.0], [-0.15, 0.9, 0.0]])
    covered = under_hat(np.concatenate([brim, crown]), hair, np.repeat(np.arange(4)[:, None], 3, axis=1))
    assert covered.tolist() == [True, False, True, False]


def test_socks_end_under_trousers_but_not_under_skirts():
    sock, face = np.array([[0.0, 0.1, 0], [0, 0.2, 0]]), np.array([[0, 0, 0], [1, 1, 1]])
    assert skin_under_hem(np.array([[0.0, 0.12, 0], [0, 1, 0]]), sock, face).tolist() == [False, True]
    assert skin_under_hem(np.array([[0.0, 0.6, 0], [0, 1, 0]]), sock, face).tolist() == [False, False]


def test_femininity_separates_the_bodies_the_shape_space_was_made_from(base):
    axis = person_module.femininity(base)
    gender = base.sample_phenotypes[:, base.phenotype_names.index("gender")]
    assert np.corrcoef(base.sample_betas @ axis, gender)[0, 1] > 0.95
    # Women's hips are wide for their shoulders: the sign of the axis is right.
    ratio = []
    for sign in (1, -1):
        body = base.vertices(sign * 2 * axis / np.linalg.norm(axis))[np.unique(base.faces)]
        crotch = -0.25
        hips = body[np.abs(body[:, 1] - (crotch + 0.1)) < 0.03][:, 0]
        waist = body[np.abs(body[:, 1] - (crotch + 0.35)) < 0.03][:, 0]
        ratio.append(np.ptp(hips) / np.ptp(waist))
    assert ratio[0] > ratio[1] + 0.05


def test_skirts_are_closed_between_the_legs_and_their_hem_is_straight(assets, base):
    for outfit in OUTFITS["female"]:
        skirt = skirt_faces(outfit, assets.proxy(outfit.path)[1])
        if not skirt.any():
            continue
        seed = next(seed for seed in range(1000) if choose(seed, person_module.femininity(base)).outfit == outfit)
        (part,) = (part for part in make_person(assets, base, seed).mesh.parts if part.name == "outfit")
        mesh = trimesh.Trimesh(part.vertices, part.faces, process=False)
        low = mesh.bounds[0, 1]
        depth = mesh.bounds[:, 2].mean()
        rays = np.array([[x, low - 0.3, depth + z] for x in (-0.03, 0, 0.03) for z in (-0.02, 0, 0.02)])
        hits, ray, _ = mesh.ray.intersects_location(rays, np.tile([0, 1.0, 0], (len(rays), 1)))
        first = [hits[ray == number, 1].min() for number in range(len(rays))]
        assert np.max(first) < low + 0.06, outfit.name


def test_outfits_are_worn_evenly_within_a_sex_and_betas_stay_in_range(base):
    axis = person_module.femininity(base)
    choices = [choose(seed, axis) for seed in range(1200)]
    for sex, outfits in OUTFITS.items():
        worn = [choice.outfit.name for choice in choices if choice.sex == sex]
        assert len(worn) == pytest.approx(600, abs=80)
        for outfit in outfits:
            expected = len(worn) / len(outfits)
            assert worn.count(outfit.name) == pytest.approx(expected, abs=4 * np.sqrt(expected))
    betas = np.stack([choice.betas for choice in choices])
    assert np.abs(betas).max() <= 2
    assert betas.std() == pytest.approx(0.9, abs=0.1)
    assert {choice.hair for choice in choices} == {None, *HAIR["female"], *HAIR["male"]}
    assert {choice.hat for choice in choices} == {None, *HATS}


def test_sex_is_the_side_of_the_femininity_axis(base):
    axis = person_module.femininity(base)
    for seed in range(50):
        betas, sex = draw_body(seed, axis)
        assert (betas @ axis > 0) == (sex == "female")


def test_same_seed_gives_the_same_person(assets, base, people):
    again = make_person(assets, base, SEEDS[1])
    assert again.attributes == people[1].attributes
    assert all(
        np.array_equal(a.vertices, b.vertices) for a, b in zip(again.mesh.parts, people[1].mesh.parts, strict=True)
    )
    assert same_pictures(again, people[1])


def test_recolouring_shares_geometry_and_changes_colours(people):
    other = recolour(people[0], 99)
    for before, after in zip(people[0].mesh.parts, other.mesh.parts, strict=True):
        assert after.name == before.name
        for field in ("vertices", "faces", "corner_uv", "skin_index", "skin_weight"):
            assert getattr(after, field) is getattr(before, field)
    assert not same_pictures(people[0], other)
    assert same_pictures(recolour(other, SEEDS[0]), people[0])


def test_every_human_wears_an_outfit_and_shoes_and_has_a_face(people):
    for person in people:
        names = [part.name for part in person.mesh.parts]
        assert len(set(names)) == len(names)
        assert {"body", "outfit", "shoes", "eyes", "eyebrows", "eyelashes"} <= set(names)
        for part in person.mesh.parts:
            assert len(part.faces) > 0
            assert np.isfinite(part.vertices).all()
            assert part.skin_weight.min() >= 0
            assert np.abs(part.skin_weight.sum(1) - 1).max() < 1e-6
            assert max(part.texture.shape) <= 1024
            assert part.faces.max() < len(part.vertices)


def test_people_stand_upright_at_adult_size(people):
    for person in people:
        assert 1.5 < person.attributes["height"] < 2.0
        low, high = person.mesh.bounds
        assert high[0] - low[0] == pytest.approx(high[1] - low[1], rel=0.25)  # arms level


def test_rigid_skinning_moves_people_as_a_whole(people):
    skinning = np.tile(np.eye(4), (24, 1, 1))
    skinning[:, :3, :3] = np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])
    skinning[:, :3, 3] = [1, 2, 3]
    for before, after in zip(people[0].mesh.parts, people[0].mesh.posed(skinning).parts, strict=True):
        expected = before.vertices @ skinning[0, :3, :3].T + [1, 2, 3]
        assert np.abs(after.vertices - expected).max() < 1e-9


def test_clothes_hide_most_of_the_body_under_them(people, base):
    for person in people:
        body = next(part for part in person.mesh.parts if part.name == "body")
        assert len(body.faces) < 0.8 * len(base.faces)


def test_skins_darken_steadily_with_tone_for_both_sexes(assets):
    for sex, light in (("female", "young_lightskinned_female_diffuse2"), ("male", "young_lightskinned_male_diffuse")):
        skins = [
            SkinColours(f"skins/textures/{light}", "skins/textures/young_darkskinned_male_diffuse", tone, (0, 0, 0))
            for tone in (0, 0.25, 0.5, 0.75, 1)
        ]
        brightness = [skin_texture(assets, skin)[200:400, 150:450, :3].mean() for skin in skins]
        assert np.diff(brightness).max() < -10, sex


def test_payloads_are_stored_whole_and_mended(assets, tmp_path, monkeypatch):
    def with_density(starts, fitted, *_):
        return [dataclasses.replace(fitted, rgb=start.rgb) for start in starts]

    monkeypatch.setattr(payloads_module, "fit_payload", lambda start, *_: start)
    monkeypatch.setattr(payloads_module, "fit_colours", with_density)
    monkeypatch.setattr(payloads_module, "_targets", lambda *_: [[]])
    reports, method = [], f"{payloads_module.METHOD} from {load_checkpoint().card['sha256'][:12]}"
    (path,) = make_payloads(assets, tmp_path, 1, 2, 3, 1, report=lambda done, total: reports.append((done, total)))
    assert reports == [(0, 1), (1, 1)]
    with np.load(path, allow_pickle=False) as file:
        voxels, attributes = file["voxels"], json.loads(str(file["attributes"]))
        assert float(file["full_density"]) == FULL_DENSITY
    assert voxels.shape == (2, 1024, 8, 8, 8, 4)
    assert np.array_equal(voxels[0, ..., 3], voxels[1, ..., 3])
    assert not np.array_equal(voxels[0], voxels[1])
    assert 0.1 < (voxels[0, ..., 3] > 0).mean() < 0.9
    assert len(attributes["variants"]) == 2
    assert is_complete(path, 2, 3, method)
    assert not is_complete(path, 3, 3, method)
    assert not is_complete(path, 2, 3, "from_mesh 2")
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    assert not is_complete(path, 2, 3, method)
    make_payloads(assets, tmp_path, 1, 2, 3, 1)
    with np.load(path, allow_pickle=False) as file:
        assert np.array_equal(file["voxels"], voxels)
    assert [entry.name for entry in tmp_path.iterdir()] == ["person_000003.npz"]


def test_fits_look_more_like_the_mesh_from_sides_not_shown_and_from_a_guess_leave_less_to_guess(
    assets, people, monkeypatch
):
    monkeypatch.setattr(payloads_module, "BODY_VIEWS", 6)
    monkeypatch.setattr(payloads_module, "HEAD_VIEWS", 4)
    colourings = [people[0].mesh, recolour(people[0], 77).mesh]
    frames = rest_frames(people[0].betas)
    low, high = people[0].mesh.bounds
    views = {
        "body": orbit_camera((low + high) / 2, 1.1 * float((high - low).max()), 33, 3, 0.5, 256),
        "head": orbit_camera(payloads_module.head_centre(people[0].betas), 0.42, 21, 5, 0.2, 128),
    }

    def psnr(payload: Payload, mesh, view: str) -> float:
        drawn, true = march(Primitives.place(frames, payload), views[view]), rasterise(mesh, views[view], 3)
        over_grey = [
            encode_srgb(np.clip(rgb + (1 - alpha[..., None]) * 0.2, 0, 1))
            for rgb, alpha in ((drawn.rgb.numpy(), drawn.alpha.numpy()), (true.rgb, true.alpha))
        ]
        return float(-10 * np.log10(np.square(over_grey[0] - over_grey[1]).mean()))

    model = load_checkpoint()

    def unexplained(payload: Payload) -> float:
        z = model.encode(payload)
        return float((z - model.encode(payloads_module.guess(model, payload))).square().mean().sqrt())

    brief = InverseSettings(steps=1, iterations=4, colour_iterations=6, pull=1.0, smoothness=0.3)
    found = [fitted_payloads(colourings, frames, people[0].betas, start, settings=brief) for start in (None, model)]
    for payloads in found:
        assert torch.equal(payloads[0].density, payloads[1].density)
        near = payloads_module.near_surface(from_mesh(colourings[0], frames))
        assert not payloads[0].density[~near].any()  # no smoke
        for payload, mesh in zip(payloads, colourings, strict=True):
            start = from_mesh(mesh, frames)
            for view in views:
                assert psnr(payload, mesh, view) > psnr(start, mesh, view) + 0.8, view
    for from_the_mesh, from_the_model in zip(*found, strict=True):
        assert unexplained(from_the_model) < 0.7 * unexplained(from_the_mesh)


def test_counts_that_make_nothing_are_rejected(tmp_path):
    with refused(ValueError, "variants is 0"):
        make_payloads(assets_module.Assets(tmp_path), tmp_path, 1, 0, 0, 1)
