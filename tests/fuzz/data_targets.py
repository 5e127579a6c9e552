"""Files of people, poses, datasets, encoders and evaluation that the backend reads; see `targets`."""

from __future__ import annotations

import json
import pickle
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import torch

from fuzz import mutations
from fuzz.mutations import Mutation
from fuzz.target import Garbage, Target, finite, finite_members

NPY: tuple[Mutation, ...] = (
    mutations.npy_header,
    mutations.npy_shape,
    mutations.npy_values,
    mutations.flip,
    mutations.truncate,
)


def random_pose() -> np.ndarray:
    return np.random.default_rng(0).normal(0, 0.3, (3, 72)).astype(np.float32)


def as_npy(folder: Path) -> Path:
    np.save(folder / "poses.npy", random_pose())
    return folder / "poses.npy"


def as_npz(folder: Path) -> Path:
    np.savez(folder / "poses.npz", pose=random_pose(), trans=np.zeros((3, 3), np.float32))
    return folder / "poses.npz"


def as_json(folder: Path) -> Path:
    (folder / "poses.json").write_text(json.dumps({"poses": random_pose().round(3).tolist()}), encoding="utf-8")
    return folder / "poses.json"


def as_pickle(folder: Path) -> Path:
    (folder / "poses.pkl").write_bytes(pickle.dumps({"poses": random_pose(), "trans": np.zeros((3, 3))}))
    return folder / "poses.pkl"


def as_mhr(ending: str) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        from support.mhr_files import mhr_arrays, write_mhr

        turns = random_pose().reshape(3, 24, 3)
        return write_mhr(folder / f"poses.{ending}", mhr_arrays(turns, np.zeros((3, 3))))

    return make


def read_poses(path: Path) -> None:
    from primdiffusion.pose_file import read_motion

    finite_members(read_motion(path))


def read_single_pose(path: Path) -> None:
    from primdiffusion.pose_file import read_pose

    finite_members(read_pose(path, 1))


def make_encoder(folder: Path) -> Path:
    from tiny_encoder import save_tiny_encoder

    return save_tiny_encoder(folder / "encoder.safetensors")


def read_encoder(path: Path) -> None:
    from primdiffusion.encoder.model import load_encoder

    finite(*load_encoder(path).encoder.state_dict().values())


def make_weights(folder: Path) -> Path:
    from primdiffusion.body.model import default_body

    count = len(default_body().template)
    np.savez(folder / "weights.npz", weights=np.linspace(0, 1, count, dtype=np.float32))
    return folder / "weights.npz"


def read_weights(path: Path) -> None:
    from primdiffusion.commands.edit import _region
    from primdiffusion.editing.regions import read_weights

    finite(read_weights(path))
    _region(cast(Any, SimpleNamespace(weights=path)), cast(Any, SimpleNamespace(body_setup=None)))


def make_solids(folder: Path) -> Path:
    corners = np.random.default_rng(0).normal(size=(4, 3, 3)).astype(np.float32)
    np.savez(folder / "solids.npz", corners=corners, colour=np.ones((4, 3), np.float32), holdout=np.zeros(4, bool))
    return folder / "solids.npz"


def read_solids(path: Path) -> None:
    from primdiffusion.commands.frame_drawer import _load_solids

    finite_members(_load_solids((str(path), 0, 0)))


def make_card(folder: Path) -> Path:
    from capture_scenes import save_person

    card = {"seed": 0, "sha256": "0" * 64, "attributes": {"outfit": "suit"}, "sources": []}
    save_person(folder / "people" / "person_000000" / "person.glb")
    path = folder / "people" / "person_000000" / "person.json"
    path.write_text(json.dumps(card), encoding="utf-8")
    return path


def read_cards(path: Path) -> None:
    from primdiffusion.people.folder import is_whole
    from primdiffusion.training.captured_people import read_cards

    is_whole(path.parent, 0)
    read_cards(path.parents[1])


def make_manifest(folder: Path) -> Path:
    asset = {"path": "hair/bun.obj", "licence": "CC0"}
    (folder / "manifest.json").write_text(json.dumps({"seed": 0, "count": 1, "assets": [asset]}), encoding="utf-8")
    return folder / "manifest.json"


def read_manifest(path: Path) -> None:
    from primdiffusion.people.folder import unknown_licences

    unknown_licences(path.parent)


def make_packed(folder: Path) -> Path:
    from diffusion_people import write_people
    from primdiffusion.training.shards import pack_people

    write_people(folder / "people", 2, variants=1)
    for _ in pack_people(folder / "people", folder / "packed", people_each=1):
        pass
    return folder / "packed" / "index.json"


def make_shard(folder: Path) -> Path:
    return next(make_packed(folder).parent.glob("*.safetensors"))


def read_packed(path: Path) -> None:
    from primdiffusion.training.shards import PackedPeople

    packed = PackedPeople(path.parent)
    for number in range(len(packed.names)):
        finite_members(packed.person(number))


def read_shard(path: Path) -> None:
    """With a checksum that fits: whoever alters a shard can alter its index."""
    from primdiffusion.training.shards import digest_of

    index = path.with_name("index.json")
    before = index.read_text(encoding="utf-8")
    changed = json.loads(before)
    for shard in changed["shards"]:
        shard["sha256"] = digest_of(path.with_name(shard["file"]))
    index.write_text(json.dumps(changed), encoding="utf-8")
    try:
        read_packed(path)
    finally:
        index.write_text(before, encoding="utf-8")


def make_attributes(folder: Path) -> Path:
    from primdiffusion.evaluation.attribute_network import AttributeNetwork, AttributeSpace, save_attribute_network

    network = AttributeNetwork(AttributeSpace({"sex": ("female", "male")}, {"height": (1.7, 0.1)}))
    save_attribute_network(folder / "attributes.safetensors", network)
    return folder / "attributes.safetensors"


def read_attributes(path: Path) -> None:
    from primdiffusion.evaluation.attribute_network import load_attribute_network

    finite(*load_attribute_network(path).state_dict().values())


def make_joints_network(folder: Path) -> Path:
    from primdiffusion.evaluation.pose_depth_network import load_pose_depth_network, save_pose_depth_network

    save_pose_depth_network(folder / "joints.safetensors", load_pose_depth_network())
    return folder / "joints.safetensors"


def read_joints_network(path: Path) -> None:
    from primdiffusion.evaluation.pose_depth_network import load_pose_depth_network

    finite(*load_pose_depth_network(path).state_dict().values())


def make_fitted(folder: Path) -> Path:
    import torch
    from primdiffusion.primitives.primitives import K, S
    from primdiffusion.training.fit_voxels import FittedVoxels, write_fitted

    voxels = torch.full((K, S, S, S), 0.5)
    channels = voxels[:, None].repeat(1, 3, 1, 1, 1)
    write_fitted(folder, "person", FittedVoxels(channels, voxels, channels[:, :2].clone(), torch.ones(K, 3)), "images")
    return folder / "person.npz"


def read_fitted_voxels(path: Path) -> None:
    from primdiffusion.training.fit_voxels import read_fitted

    fitted = read_fitted(path.parent, path.stem)
    finite(fitted.rgb, fitted.density, fitted.weight, fitted.extent)


def make_state_dict(folder: Path) -> Path:
    torch.save({"layer.weight": torch.ones(3, 4), "layer.bias": torch.zeros(3)}, folder / "network.pth")
    return folder / "network.pth"


def read_state_dict(path: Path) -> None:
    from primdiffusion.evaluation.pretrained_networks import read_weights

    read_weights(path)


def of_shots(name: str) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        from PIL import Image

        Image.fromarray(np.full((16, 16, 3), 200, np.uint8)).save(folder / "a.png")
        (folder / "joints.json").write_text(json.dumps({"a.png": [[3, 4]] * 24}), encoding="utf-8")
        (folder / "depth").mkdir()
        np.save(folder / "depth" / "a.npy", np.ones((16, 16), np.float32))
        return folder / name

    return make


def read_shots(path: Path) -> None:
    from primdiffusion.evaluation.shots import folder_shots

    for shot in folder_shots(path.parent if path.suffix != ".npy" else path.parents[1]):
        finite(shot.rgb, *([] if shot.joints is None else [shot.joints]))
        if shot.depth is not None and torch.isnan(shot.depth).any():
            raise Garbage("depth that is NaN")


def state_of(network: torch.nn.Module):
    from primdiffusion.training.config import PhaseConfig
    from primdiffusion.training.state import TrainingState, accelerator_of

    return TrainingState(network, PhaseConfig(steps=2, batch=1), accelerator_of())


def make_state(folder: Path) -> Path:
    state = state_of(torch.nn.Linear(3, 2))
    state.update(state.network(torch.ones(1, 3)).sum())
    state.save(folder / "state.safetensors")
    return folder / "state.safetensors"


def read_state(path: Path) -> None:
    state = state_of(torch.nn.Linear(3, 2))
    state.load(path)
    finite(*state.network.state_dict().values(), *state.average.state_dict().values())


def make_gallery(folder: Path) -> Path:
    from diffusion_people import write_people

    write_people(folder, 1, variants=2)
    return next(folder.glob("person_*.npz"))


def read_gallery(path: Path) -> None:
    from primdiffusion.evaluation.gallery import read_attributes

    read_attributes(path)


def make_licences(folder: Path) -> Path:
    text = "path | licence\n--- | ---\nhair/bun.obj | CC0\nclothes/suit.obj | CC-BY (Anna)\n"
    (folder / "LICENSES.txt").write_text(text, encoding="utf-8")
    return folder / "LICENSES.txt"


def read_licences(path: Path) -> None:
    from primdiffusion.people.assets import _listed, licence_of

    _listed.cache_clear()
    if not isinstance(licence_of(path.parent, "hair/bun.obj"), str):
        raise Garbage("a licence that is no text")


TARGETS = (
    Target("poses .npy", as_npy, NPY, read_poses),
    Target("poses .npz", as_npz, mutations.NPZ, read_poses),
    Target("poses .json", as_json, mutations.JSON, read_poses),
    Target("poses .pkl", as_pickle, mutations.PLAIN, read_poses),
    Target("MHR .npz", as_mhr("npz"), mutations.NPZ, read_poses),
    Target("MHR .json", as_mhr("json"), mutations.JSON, read_poses),
    Target("pose .npz", as_npz, mutations.NPZ, read_single_pose),
    Target("encoder", make_encoder, mutations.SAFETENSORS, read_encoder),
    Target("painted weights", make_weights, mutations.NPZ, read_weights),
    Target("solids", make_solids, mutations.NPZ, read_solids),
    Target("human's card", make_card, mutations.JSON, read_cards),
    Target("manifest", make_manifest, mutations.JSON, read_manifest),
    Target("packed index", make_packed, mutations.JSON, read_packed),
    Target("fitted voxels", make_fitted, mutations.NPZ, read_fitted_voxels),
    Target("packed shard", make_shard, mutations.SAFETENSORS, read_shard),
    Target("payload of a gallery", make_gallery, mutations.NPZ, read_gallery),
    Target("training state", make_state, mutations.SAFETENSORS, read_state),
    Target("attribute network", make_attributes, mutations.SAFETENSORS, read_attributes),
    Target("joints network", make_joints_network, mutations.SAFETENSORS, read_joints_network),
    Target("network .pth", make_state_dict, mutations.TORCH, read_state_dict),
    Target("shot", of_shots("a.png"), mutations.PLAIN, read_shots),
    Target("joints of shots", of_shots("joints.json"), mutations.JSON, read_shots),
    Target("depth of a shot", of_shots("depth/a.npy"), NPY, read_shots),
    Target("licences", make_licences, mutations.TEXT, read_licences),
)
