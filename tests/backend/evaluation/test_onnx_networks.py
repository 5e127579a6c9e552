"""Pose and depth networks from ONNX files: tiny ones whose answers are known."""

import numpy as np
import pytest
import torch
from primdiffusion.evaluation.images import SIDE
from primdiffusion.evaluation.images import TestImage as Picture
from primdiffusion.evaluation.onnx_networks import open_depth_network, open_onnx, open_pose_network
from primdiffusion.evaluation.pose_depth_network import depth_error
from support.errors import refused

onnx = pytest.importorskip("onnx", reason="onnx is not installed: pip install onnx onnxruntime")
pytest.importorskip("onnxruntime", reason="onnxruntime is not installed: pip install onnxruntime")


def save(path, nodes, outputs, constants=(), size=(256, 192)):
    """A network with one picture as its input."""
    helper, kind = onnx.helper, onnx.TensorProto.FLOAT
    graph = helper.make_graph(
        nodes,
        "tiny",
        [helper.make_tensor_value_info("picture", kind, [1, 3, *size])],
        [helper.make_tensor_value_info(name, kind, None) for name in outputs],
        [onnx.numpy_helper.from_array(array, name) for name, array in constants],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)])
    model.ir_version = 8
    onnx.save(model, str(path))
    return path


def always(path, **arrays):
    """A network that gives the same outputs for every picture."""
    nodes = [onnx.helper.make_node("Identity", [f"{name}_"], [name]) for name in arrays]
    return save(path, nodes, list(arrays), [(f"{name}_", array) for name, array in arrays.items()])


@pytest.fixture
def image():
    """A human between 100 and 300 pixels across, 50 and 450 down; nearer where it is brighter."""
    mask = torch.zeros(SIDE, SIDE, dtype=torch.bool)
    mask[50:450, 100:300] = True
    shade = torch.linspace(20, 220, SIDE)[:, None].expand(SIDE, SIDE)
    rgb = torch.where(mask, shade, 255).round().to(torch.uint8)[..., None].expand(-1, -1, 3).contiguous()
    depth = torch.where(mask, 1 / (0.2 + rgb[..., 0] / 2000), torch.inf)
    return Picture("one", rgb / 255, mask.float(), joints=torch.zeros(12, 2), head_size=20.0, depth=depth)


def crop_to_picture(x, y):
    """Of crops 192 x 256 around the human of `image`: its box is 200 x 400, 1.25 times as large, 3:4."""
    scale = 500 / 256
    return [200 + (x - 96) * scale, 250 + (y - 128) * scale]


def test_simcc_is_read_at_its_maximum(image, tmp_path):
    x, y = np.zeros((1, 17, 384), np.float32), np.zeros((1, 17, 512), np.float32)
    x[:, :, 100], y[:, :, 300] = 1, 1
    x[0, 5, 100], x[0, 5, 200] = 0, 1  # the left shoulder
    found = open_pose_network(always(tmp_path / "pose.onnx", simcc_x=x, simcc_y=y)).joints(image)
    assert found[0].tolist() == pytest.approx(crop_to_picture(100, 150))
    assert found[1:].tolist() == [pytest.approx(crop_to_picture(50, 150))] * 11


def test_heatmaps_are_read_a_quarter_of_a_cell_towards_the_larger_neighbour(image, tmp_path):
    maps = np.zeros((1, 17, 64, 48), np.float32)
    maps[:, :, 30, 20], maps[:, :, 30, 21], maps[:, :, 29, 20] = 1, 0.5, 0.5
    found = open_pose_network(always(tmp_path / "pose.onnx", heatmap=maps)).joints(image)
    assert found[0].tolist() == pytest.approx(crop_to_picture(20.25 * 4, 29.75 * 4))


def test_a_pose_network_sees_the_human_in_the_middle(image, tmp_path):
    """Heatmaps of darkness: the darkest pixel, at the top of the human, is found again."""
    image.rgb[60, 180] = 0
    nodes = [
        onnx.helper.make_node("ReduceMean", ["picture"], ["grey"], axes=[1], keepdims=1),
        onnx.helper.make_node("Neg", ["grey"], ["dark"]),
        onnx.helper.make_node("Concat", ["dark"] * 17, ["heatmap"], axis=1),
    ]
    image.rgb[56:66, 176:186] = 0
    found = open_pose_network(save(tmp_path / "pose.onnx", nodes, ["heatmap"])).joints(image)
    assert (found - torch.tensor([180.5, 60.5])).abs().max() < 8


def test_a_picture_without_a_human_has_no_joints(image, tmp_path):
    maps = np.zeros((1, 17, 64, 48), np.float32)
    network = open_pose_network(always(tmp_path / "pose.onnx", heatmap=maps))
    image.alpha[:] = 0
    assert network.joints(image) is None


@pytest.mark.parametrize(("values", "sign"), [("inverted", 1.0), ("depth", -1.0)])
def test_a_depth_network_that_sees_brightness_has_no_error(image, tmp_path, values, sign):
    nodes = [onnx.helper.make_node("ReduceMean", ["picture"], ["grey"], axes=[1], keepdims=0)]
    if sign < 0:  # of "half" normalisation, 1 / (0.8 + grey) is the depth
        nodes += [
            onnx.helper.make_node("Add", ["grey", "offset"], ["raised"]),
            onnx.helper.make_node("Reciprocal", ["raised"], ["out"]),
        ]
    else:
        nodes.append(onnx.helper.make_node("Identity", ["grey"], ["out"]))
    constants = [("offset", np.full(1, 1.8, np.float32))] if sign < 0 else []
    path = save(tmp_path / "depth.onnx", nodes, ["out"], constants, (SIDE, SIDE))
    inverted = open_depth_network(path, "half", values).inverted(image)
    assert depth_error(inverted, image.depth, image.mask) < 1e-4


def test_files_that_do_not_fit_are_one_sentence(image, tmp_path):
    large = save(tmp_path / "large.onnx", [onnx.helper.make_node("Neg", ["picture"], ["a"])], ["a"], size=(64, 10**7))
    with refused(ValueError, "10000000 x 64 pixels", "2048"):
        open_onnx(large, (8, 8))
    few = always(tmp_path / "few.onnx", heatmap=np.zeros((1, 5, 64, 48), np.float32))
    with refused(ValueError, "5 keypoints"):
        open_pose_network(few).joints(image)
    flat = always(tmp_path / "flat.onnx", numbers=np.zeros((1, 5), np.float32))
    with refused(ValueError, "heatmap"):
        open_pose_network(flat).joints(image)
    with refused(ValueError, "network"):
        open_depth_network(few, "imagenet", "inverted").inverted(image)
