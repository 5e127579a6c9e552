"""The authors' checkpoints: what a file must hold, tensor by tensor, and what is rejected."""

import os
import pickle

import pytest
import torch
from primdiffusion.commands.import_released import read_released
from primdiffusion.diffusion.schedule import linear
from primdiffusion.diffusion.unet import PAPER, PAPER_WITH_ATTENTION, SlabUNet
from primdiffusion.files.regular_files import FileError
from primdiffusion.released.inventory import take_inventory
from primdiffusion.released.reading import read_weights
from primdiffusion.runtime.failures import to_user_error
from released_files import SMALL, T, blank, save_released, schedule_buffers, stage_one, state, template
from support.errors import refused

EVERY = pytest.mark.parametrize("every", [7, pytest.param(1, marks=pytest.mark.slow)])
"""Which tensors are tried: all of them by the slow tests."""
DROPPED = ("lbs_fn", "geo_fn", "decoder_geom")


def shapes_of(config) -> dict[str, torch.Tensor]:
    with torch.device("meta"):
        network = SlabUNet(config)
    return {name: blank(*value.shape) for name, value in network.state_dict().items()}


@pytest.fixture(scope="module")
def released() -> dict[str, torch.Tensor]:
    """All names and real shapes, in no memory."""
    return state(shapes_of(PAPER), template())


def test_all_475_tensors_are_accounted_for(released):
    inventory = take_inventory(released)
    assert inventory.unet == PAPER
    assert [entry.key for entry in inventory.account.entries] == list(released)
    fates = {(row["group"], row["fate"]): row["tensors"] for row in inventory.account.groups()}
    assert len(released) == sum(fates.values()) == 475
    assert all(entry.note for entry in inventory.account.entries), "with a reason"
    assert fates == {
        ("schedule", "checked"): 12, ("lbs_fn", "dropped"): 7, ("geo_fn", "dropped"): 7,
        ("local_pose_conv_block", "imported"): 9, ("joint_conv_block", "imported"): 9, ("embs_encoder", "imported"): 42,
        ("decoder_motion", "imported"): 15, ("decoder_rgb", "imported"): 9, ("decoder_alpha", "imported"): 9,
        ("decoder_geom", "dropped"): 12, ("transformer", "imported"): 46, ("diffusion", "imported"): 298,
    }  # fmt: skip
    imported = [entry for entry in inventory.account.entries if entry.fate == "imported"]
    assert sum(torch.Size(entry.shape).numel() for entry in imported) == 84_846_776 + 7_190_747


@pytest.mark.parametrize("config", [PAPER_WITH_ATTENTION, SMALL])
def test_size_and_attention_of_the_denoiser_are_read_off_its_tensors(config):
    assert take_inventory(state(shapes_of(config), template())).unet == config


@EVERY
def test_each_tensor_that_is_taken_away_is_missed_by_name_or_group(released, every):
    for key in list(released)[::every]:
        if any(f"bodydecoder.{group}." in key for group in DROPPED):
            continue
        with pytest.raises(ValueError) as caught:
            take_inventory({name: value for name, value in released.items() if name != key})
        prefix, group = [*key.split("."), ""][:2]
        expected = key if prefix != "bodydecoder" else group
        assert expected in str(caught.value), f"{key}: {caught.value}"


WIDE = "bodydecoder.transformer.transformer_blocks.1.ff.net.2.weight"
BIAS = "diffusion.time_embed.0.bias"


@pytest.mark.parametrize(
    ("key", "value", "names"),
    [
        *((key, blank(3), ()) for key in (
            "extra", "diffusion.extra.weight", "bodydecoder.extra.weight", "logvar", "bodydecoder.decoder_rgb.0.extra",
            "diffusion.input_blocks.12.0.op.weight",
        )),
        (WIDE, blank(256, 512), ("(256, 512)", "(256, 1024)")),
        ("alphas_cumprod", linear().alpha_bar.float(), ()),
        (BIAS, torch.nan, ()),
        (BIAS, torch.inf, ()),
    ],
)  # fmt: skip
def test_a_tensor_too_many_of_another_width_or_schedule_or_not_finite_is_named(released, key, value, names):
    with refused(ValueError, key.removeprefix("bodydecoder.transformer.transformer_blocks.1."), *names):
        take_inventory({**released, key: torch.full_like(released[key], value) if key == BIAS else value})


def test_tensors_that_are_dropped_stop_nothing(released):
    """Whatever their number, shape and type."""
    strange = {
        key: torch.zeros(2, 3, dtype=torch.int8) if any(f"bodydecoder.{group}." in key for group in DROPPED) else value
        for key, value in released.items()
        if not key.startswith("bodydecoder.decoder_geom.")
    }
    strange["bodydecoder.lbs_fn.extra"] = torch.zeros(0)
    account = take_inventory(strange).account
    assert len(account.entries) == len(strange) == 475 - 12 + 1
    assert {entry.fate for entry in account.entries if entry.group in DROPPED} == {"dropped"}


@EVERY
def test_each_tensor_of_another_shape_is_named(released, every):
    settled = [key for key in released if not any(part in key for part in ("lbs_fn", "geo_fn", "decoder_geom"))]
    for key in settled[::every]:
        other = blank(*(side + 1 for side in released[key].shape))
        with pytest.raises(ValueError) as caught:
            take_inventory({**released, key: other})
        assert f"'{key}'" in str(caught.value), str(caught.value)
        assert str(tuple(other.shape)) in str(caught.value)


@pytest.mark.parametrize("name", schedule_buffers())
def test_a_schedule_buffer_that_does_not_follow_from_the_schedule_is_named(released, name):
    wrong = released[name].clone()
    wrong[500] *= 1.001
    with refused(ValueError, f"'{name}'", "step 500"):
        take_inventory({**released, name: wrong})


def test_both_ways_to_write_the_clipped_logarithm_are_known(released):
    name = "posterior_log_variance_clipped"
    other = released[name].clone()
    other[0] = other[1]
    assert len(take_inventory({**released, name: other}).account.entries) == 475


def test_a_stage_1_file_is_accounted_for_with_and_without_its_wrapping(tmp_path):
    tensors = stage_one(template())
    for content in (tensors, {"model_state_dict": tensors}):
        torch.save(content, tmp_path / "stage1.pt")
        inventory = take_inventory(read_weights(tmp_path / "stage1.pt"))
        assert inventory.unet is None
        assert len(inventory.account.entries) == 165


def test_reading_gives_the_tensors_without_the_optimiser(tmp_path, released):
    read = read_weights(save_released(tmp_path / "primdiffusion.pt", released))
    assert list(read) == list(released)
    assert torch.equal(read["betas"], released["betas"])
    assert len(read["betas"]) == T


class Hostile:
    def __reduce__(self):
        return os.mkdir, (os.environ["HOSTILE"],)


def bad_file(path, kind):
    """Writes a file and returns what the error must say."""
    if kind == "hostile torch file":
        torch.save({"model_state_dict": {"betas": Hostile()}}, path)
        return "nothing was executed"
    if kind == "hostile pickle":
        path.write_bytes(pickle.dumps({"model_state_dict": Hostile()}, 2))
        return "not a torch file|nothing was executed"
    contents = {
        "a list": ([1, 2], "list"),
        "other keys": ({"epoch": 3, "net": {"a": torch.zeros(1)}}, "'epoch'.* is a int.*'model_state_dict'"),
        "a sparse tensor": ({"model_state_dict": {"betas": torch.eye(3).to_sparse()}}, "not a dense tensor"),
        "no tensors": ({"model_state_dict": {"betas": 3}}, "'betas'"),
        "a tensor": (torch.zeros(3), "Tensor"),
        "another network": ({"model_state_dict": {"conv.weight": torch.zeros(3)}}, "conv.weight"),
        "nothing": ({}, "none of the 0 tensors"),
    }
    content, expected = contents[kind]
    torch.save(content, path)
    return expected


@pytest.mark.parametrize(
    "kind", ["hostile torch file", "hostile pickle", "a list", "a sparse tensor",
             "other keys", "no tensors", "a tensor", "another network", "nothing"]
)  # fmt: skip
def test_what_is_no_released_checkpoint_is_rejected_in_one_sentence(tmp_path, monkeypatch, kind):
    monkeypatch.setenv("HOSTILE", str(tmp_path / "ran"))
    expected = bad_file(tmp_path / "file.pt", kind)
    with pytest.raises(ValueError, match=expected) as caught:
        take_inventory(read_weights(tmp_path / "file.pt"))
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 400
    assert not (tmp_path / "ran").exists()


def test_names_of_a_strangers_tensors_make_no_long_sentence_without_the_file(tmp_path):
    path = tmp_path / "x.pt"
    names = (["w"], [f"{number}{'a' * 70}" for number in range(9)], [f"img_encoder.{'b' * 50}{i}" for i in range(20)])
    for each in names:
        torch.save({name: torch.zeros(2) for name in each}, path)
        with refused(FileError, str(path)) as caught:
            read_released(path)
        assert len(str(to_user_error(caught.value))) - len(str(tmp_path)) <= 300
