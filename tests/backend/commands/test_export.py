"""`primdiffusion export` and the child's jobs proxy and gaussians."""

import numpy as np
import pytest
import splatter
import trimesh
from export_people import person
from primdiffusion import cli
from primdiffusion.commands.export import gaussians, proxy
from primdiffusion.commands.session import Session
from primdiffusion.formats.requests import GaussiansRequest, PosedPerson, ProxyRequest
from primdiffusion.human import place, pose_body
from primdiffusion.human_file import save_human

COARSE = ["--triangles", "800", "--texture", "64"]


@pytest.fixture
def saved(tmp_path):
    path = tmp_path / "anna.human"
    save_human(path, person())
    return path


def silent(*_args, **_named):
    pass


def test_a_person_becomes_a_glb(saved, capsys):
    out = saved.with_name("anna.glb")
    cli.run(["export", str(saved), "--out", str(out), *COARSE])
    assert capsys.readouterr().out.strip() == str(out)
    assert len(trimesh.load(out).geometry["person"].faces) <= 800


def test_a_posed_person_becomes_gaussians(saved):
    pose = saved.with_name("pose.json")
    pose.write_text(str([0.0] * 49 + [-1.2] + [0.0] * 22))
    bent = saved.with_name("b.ply")
    cli.run(["export", str(saved), "--out", str(bent), "--gaussians", "3000", "--pose", str(pose)])
    ply = splatter.read_ply(bent)
    assert float(place(person()).position[:, 0].max()) > ply["x"].max() + 0.05
    assert ply["y"].min() == pytest.approx(0, abs=0.05), "the soles are on the floor"


@pytest.mark.parametrize(
    ("more", "sentence"),
    [
        (["--out", "anna.stl"], "^out is 'anna.stl': give"),
        (["--out", "anna.glb", "--pose", "pose.json"], "^pose cannot be stored"),
        (["--out", "anna.ply", "--frame", "2"], "^frame is 2"),
        (["--out", "nowhere/anna.glb"], "there is no folder"),
    ],
)
def test_what_cannot_be_exported_is_rejected_before_any_work(saved, monkeypatch, more, sentence):
    monkeypatch.chdir(saved.parent)
    with pytest.raises((ValueError, FileNotFoundError), match=sentence):
        cli.run(["export", str(saved), *more])
    assert list(saved.parent.iterdir()) == [saved]


def test_the_childs_proxy_follows_other_betas(saved, tmp_path):
    params = {"person": saved, "triangles": 800, "texture_px": 64, "spacing": 0.02}
    own = proxy(ProxyRequest(out_dir=tmp_path / "own", **params), Session(), silent)
    tall = proxy(ProxyRequest(out_dir=tmp_path / "tall", betas=[3.0] + [0.0] * 9, **params), Session(), silent)
    heights = []
    for result in (own, tall):
        with np.load(result.proxy) as arrays:
            heights.append(np.ptp(arrays["vertices"][:, 1]))
            assert arrays["joint_names"][0] == "pelvis"
    assert abs(heights[1] - heights[0]) > 0.03


def test_the_childs_gaussians_stand_where_the_armature_does(saved, tmp_path):
    skinning = pose_body(person().betas).skinning[:, :3].tolist()
    moved = [[1.0, 0, 0, 2.0], [0, 1.0, 0, 0], [0, 0, 1.0, 0]]
    request = GaussiansRequest(person=PosedPerson(saved, moved, skinning), out=tmp_path / "p.ply", limit=2000)
    assert gaussians(request, Session(), silent).gaussians == 2000
    assert splatter.read_ply(tmp_path / "p.ply")["x"].mean() == pytest.approx(2.0, abs=0.1)


def test_a_cancelled_proxy_leaves_nothing(saved, tmp_path):
    def cancel(stage, *_):
        if stage == "write":
            raise InterruptedError

    request = ProxyRequest(person=saved, out_dir=tmp_path / "new", triangles=800, texture_px=64, spacing=0.03)
    with pytest.raises(InterruptedError):
        proxy(request, Session(), cancel)
    assert not (tmp_path / "new").exists()


def test_betas_of_another_body_are_rejected(saved, tmp_path):
    request = ProxyRequest(person=saved, out_dir=tmp_path / "out", betas=[0.0] * 3)
    with pytest.raises(ValueError, match="3 betas"):
        proxy(request, Session(), silent)
