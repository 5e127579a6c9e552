"""The paper's tables: of a model and of folders, repeatable, empty columns with a reason, too few pictures."""

import dataclasses
import json
import math

import numpy as np
import pytest
import torch
from PIL import Image as Pillow
from primdiffusion.commands import evaluate as command
from primdiffusion.evaluation.images import JOINTS, SIDE
from primdiffusion.evaluation.images import TestImage as Picture
from primdiffusion.evaluation.pose_depth_network import joint_positions, load_pose_depth_network, shrunk
from primdiffusion.evaluation.tables import (
    COLUMNS,
    Cell,
    Networks,
    Scores,
    check_counts,
    compare_pictures,
    look_at_pictures,
    remarks,
    table,
)
from primdiffusion.geometry.image import Image, decode_srgb
from support.errors import refused
from support.tiny import tiny_model


def judged(count: int, seed: int, shift: float = 0.0, correct: list[float] | None = None) -> Scores:
    generator = torch.Generator().manual_seed(seed)
    widths = {"own": 6, "detail": 3, "inception": 8, "clip": 5}
    features = {name: torch.randn(count, width, generator=generator) + shift for name, width in widths.items()}
    return Scores(count, features, correct or [], [])


def images(count: int, seed: int) -> list[Picture]:
    """Boxes in random places; a plane of depth."""
    generator = torch.Generator().manual_seed(seed)
    found = []
    for _ in range(count):
        left, top = torch.randint(50, 200, (2,), generator=generator).tolist()
        mask = torch.zeros(SIDE, SIDE, dtype=torch.bool)
        mask[top : top + 250, left : left + 150] = True
        shade = torch.randint(0, 200, (SIDE, SIDE, 3), generator=generator, dtype=torch.uint8)
        depth = torch.where(mask, torch.linspace(3, 4, SIDE)[:, None], torch.inf)
        joints = torch.tensor([left, top]) + 100 * torch.rand(len(JOINTS), 2, generator=generator)
        rgb = np.where(mask[..., None], decode_srgb(shade.float() / 255), 0).astype(np.float32)
        found.append(Picture(Image(rgb, mask.float().numpy(), depth.numpy()), joints, head_size=30.0))
    return found


def folder(path, count: int, seed: int):
    path.mkdir()
    for number, image in enumerate(images(count, seed)):
        Pillow.fromarray(image.pixels.numpy()).save(path / f"{number}.png")
    return path


def test_distances_grow_with_the_shift_and_reals_are_compared_with_themselves():
    real = judged(40, 0)
    near, far = (compare_pictures(judged(40, 1, shift), real, 5, 20)["generated"] for shift in (0.0, 1.0))
    for column in ("fid", "fid_clip", "kid", "own_distance"):
        assert near[column].value < far[column].value
    halves = compare_pictures(judged(40, 1), real, 5, 20)["real"]["own_distance"].value
    assert halves == pytest.approx(near["own_distance"].value, rel=0.5)


def test_own_distances_are_of_sets_of_one_size():
    """Frechet distances fall with the number of pictures: more generated ones do not lower it."""
    few, many = (compare_pictures(judged(count, 1), judged(40, 0), 5, 8) for count in (20, 2000))
    assert few["generated"]["own_distance"].value == pytest.approx(many["generated"]["own_distance"].value, rel=0.5)


def test_a_known_share_of_joints_is_the_pckh():
    rows = compare_pictures(judged(10, 1, correct=[1.0] * 9 + [0.5]), judged(10, 0), 5, 8)
    assert rows["generated"]["own_pckh"][:2] == pytest.approx((95, 15))


def test_empty_columns_say_why():
    fake = judged(10, 1)
    bare = Scores(10, {name: fake.features[name] for name in ("own", "detail")}, fake.correct, fake.depth)
    cells = compare_pictures(bare, bare, 5, 8)["generated"]
    assert all(cells[column].value is None for column in COLUMNS if column != "own_distance")
    assert "--inception" in cells["fid"].reason
    assert "--clip" in cells["fid_clip"].reason
    assert "joints" in cells["own_pckh"].reason
    assert "100 need" in compare_pictures(fake, fake, 5, 100)["generated"]["kid"].reason
    text = table({"generated": cells}, {"poses": ["a", "b"], "FPS": None})
    assert f"FID is empty: {cells['fid'].reason}." in text
    assert "poses: a, b" in text


def test_scores_that_real_pictures_do_not_win_are_said_not_to_discriminate():
    """Figures of docs/results/tables_table.md: no ranking can be read from a score that renders of meshes lose."""

    def row(joints: float | None, depth: float | None) -> dict[str, Cell]:
        return {"own_pckh": Cell(joints), "own_depth": Cell(depth), "fid": Cell(None, reason="no weights file")}

    rows = {
        "ours": row(49.28, 133.5),
        "voxels": row(35.29, 119.3),
        "real": row(37.92, 150.4),
        "floor": row(31.41, 103.2),
    }
    joints, depth = remarks(rows)
    assert joints.startswith("own PCKh@0.5 does not discriminate: real pictures have 37.92, which ours 49.28 reach or")
    assert depth.startswith("own depth x 100 does not discriminate: real pictures have 150.4, which ours 133.5, voxels")
    assert joints in table(rows | {"ours": rows["ours"] | empty()}, {})
    assert remarks({"generated": row(30.0, 160.0), "real": row(37.92, 150.4)}) == []


def empty() -> dict[str, Cell]:
    return {
        name: Cell(None, reason="it was not asked for") for name in COLUMNS if name not in ("own_pckh", "own_depth")
    }


def test_frechet_distances_of_few_pictures_are_said_to_be_biased():
    few, many = (compare_pictures(judged(count, 1), judged(2 * count, 0), 5, 8) for count in (79, 90))
    assert "FID: 79 samples for 8 features are fewer than 10 each (80): the distance is biased" in table(few, {})
    assert [text.partition(":")[0] for text in remarks(few)] == ["FID", "own distance"]
    assert remarks(many) == []


def test_ten_fakes_against_five_reals_are_one_sentence(tmp_path):
    with refused(ValueError, "10 generated", "5 real"):
        check_counts(10, 5)
    fake, real = folder(tmp_path / "fake", 10, 0), folder(tmp_path / "real", 5, 1)
    with refused(ValueError, "10 generated", "5 real"):
        command.run(["generation", "--fake", str(fake), "--real", str(real)])


def test_weights_with_nan_are_one_sentence():
    fake = judged(10, 1)
    fake.features["inception"][0, 0] = torch.nan
    with refused(ValueError, "NaN"):
        compare_pictures(fake, judged(10, 0), 5, 8)


def test_joints_are_judged_against_the_truth_of_each_picture():
    network = load_pose_depth_network()
    given = images(3, 0)
    seen = joint_positions(network(torch.stack([shrunk(image.pixels) for image in given]).float() / 255).heatmaps)
    right = look_at_pictures(
        [dataclasses.replace(image, joints=SIDE * own) for image, own in zip(given, seen, strict=True)],
        Networks(network),
    )
    assert right.correct == [1.0] * 3
    first = look_at_pictures(given, Networks(network))
    assert first.pictures == len(first.correct) == len(first.depth) == 3
    assert first.features["own"].shape == (3, 64)
    assert torch.equal(look_at_pictures(given, Networks(network)).features["own"], first.features["own"])


def test_folders_are_compared_twice_with_the_same_bits(tmp_path, capsys):
    fake, real = folder(tmp_path / "fake", 9, 0), folder(tmp_path / "real", 16, 1)
    for name in ("one", "two"):
        line = ["generation", "--fake", str(fake), "--real", str(real), "--kid-subset-size", "4"]
        command.run([*line, "--json", str(tmp_path / f"{name}.json")])
    first, second = ((tmp_path / f"{name}.json").read_bytes() for name in ("one", "two"))
    assert first == second
    record = json.loads(first)
    assert record["choices"]["generated pictures"] == f"9: {fake}"
    assert record["rows"]["generated"]["own_pckh"]["value"] is None
    assert math.isfinite(record["rows"]["generated"]["own_distance"]["value"])
    printed = capsys.readouterr().out
    assert "| pictures | FID_CLIP |" in printed
    assert all(f"{name}: " in printed for name in record["choices"])


def test_a_model_has_all_of_our_own_measures_and_a_frame_rate(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(command, "load_checkpoint", lambda path, device: tiny_model())
    real = folder(tmp_path / "real", 8, 1)
    line = ["generation", "--real", str(real), "--count", "2", "--poses", "2", "--views", "2"]
    command.run([*line, "--steps", "2", "--json", str(tmp_path / "a.json")])
    record = json.loads((tmp_path / "a.json").read_text())
    cells = record["rows"]["generated"]
    assert cells.pop("fps")["value"] > 0
    assert all(cells[column]["value"] is not None for column in ("own_distance", "own_pckh", "own_depth"))
    assert set(cells) == set(COLUMNS) - {"fps"}
    assert record["choices"]["resolution"] == "256 x 256 x 8"
    assert record["rows"]["floor"]["own_pckh"]["value"] == load_pose_depth_network().card["errors"]["pckh"]
    assert "| floor |" in capsys.readouterr().out
