"""Checkpoint files: weights, codec, prior and model card in one safetensors file."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

from primdiffusion.body.model import LARGEST_BETA
from primdiffusion.diffusion.codec import CellCodec, LinearCodec, ReleasedSlab, WholeSlab
from primdiffusion.diffusion.conditioning import AttributeVocabulary
from primdiffusion.diffusion.denoiser import LocalUNetConfig, PersonDenoiser
from primdiffusion.diffusion.gaussian import PersonPrior
from primdiffusion.diffusion.model import (
    BETAS,
    STANDARD_SHAPES,
    DiffusionModel,
    ShapePrior,
    check_codec,
    check_parts,
    check_surfaces,
)
from primdiffusion.diffusion.schedule import CHAINS, SCHEDULES
from primdiffusion.diffusion.surfaces import LARGEST, NUMBERS, Surfaces, optional_fields
from primdiffusion.diffusion.unet import SlabUNet, UNetConfig
from primdiffusion.files import tensor_file
from primdiffusion.files.arrays import LARGEST_NUMBER
from primdiffusion.files.json_files import parse_json
from primdiffusion.files.regular_files import FileError, as_file_error, open_regular
from primdiffusion.files.tensor_file import under
from primdiffusion.files.whole_files import write_atomically
from primdiffusion.formats.schema import Open, Range, read
from primdiffusion.geometry.records import TensorRecord
from primdiffusion.primitives.anchors import Anchors
from primdiffusion.primitives.body_setup import BodyFiles, BodySetup, find_body_setup
from primdiffusion.primitives.primitives import GRID

FORMAT = "primdiffusion-checkpoint"
RELEASED = "released"
"""Kind of the architecture in an imported checkpoint."""
ENCODER_FORMAT = "primdiffusion-encoder"
"""Format of the files of `encoder.model`."""
FORMAT_VERSION = 2
_READABLE = {FORMAT: str(FORMAT_VERSION), ENCODER_FORMAT: "1"}
_HALVED = ("codec.mean", "codec.basis", "denoiser.", "surfaces.sampled", "surfaces.worn")
_WHOLE = ("prior_variance", "prior_head_variance", "prior_log_weight")
WEIGHTS = "model.safetensors"
"""The checkpoint in a folder of `save_pretrained` or of `hf download`."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class ModelConfig(Open):
    """Architecture of a checkpoint's model, under "architecture" in its metadata."""

    kind: Literal["person", "slab", "released"]
    """Denoiser: a PersonDenoiser, a SlabUNet, or the authors' U-Net on a body of the user."""
    schedule: Literal["linear", "sqrt_linear", "fine_linear"]
    """Noise schedule."""
    chain: Literal["trailing", "early", "released"]
    """Timesteps of samplers."""
    full_density: Annotated[float, Range(1e-30, LARGEST_NUMBER)]
    """Density of a stored value of 1, 1/m."""
    config: dict
    """Sizes of the denoiser's network: of a LocalUNetConfig under "local", or of a UNetConfig."""
    vocabulary: dict = dataclasses.field(default_factory=lambda: AttributeVocabulary({}, {}).to_json())
    """Attributes that the model can be conditioned on (`AttributeVocabulary.to_json`)."""
    body: str = ""
    """The user's body of a released model, as JSON (`BodyFiles.to_json`)."""

    def local(self) -> LocalUNetConfig | None:
        """Return the sizes of a PersonDenoiser's network. Raises FieldError, and KeyError."""
        return None if self.config["local"] is None else read(LocalUNetConfig, self.config["local"])

    def unet(self) -> UNetConfig:
        """Return the sizes of a U-Net. Raises FieldError."""
        return read(UNetConfig, self.config)


def default_checkpoint() -> Path:
    """Path of the weights that ship with the package."""
    return Path(str(resources.files("primdiffusion.weights") / "default.safetensors"))


def checkpoint_file(path: Path | str | None = None) -> Path:
    """Find the checkpoint that a path stands for: a file, or the one in a folder; None: the default checkpoint.

    Folders are those of `save_pretrained` and those that `hf download` prints. Nothing is downloaded. Raises FileError
    for a folder without a model.
    """
    if path is None:
        return default_checkpoint()
    path = Path(path)
    if path.is_dir() and not (path / WEIGHTS).is_file():
        raise FileError(path, f"holds no {WEIGHTS}", "give a folder of save_pretrained, or the one hf download prints")
    return path / WEIGHTS if path.is_dir() else path


def save_checkpoint(path: Path, model: DiffusionModel, schedule: str) -> None:
    """Write a model with networks, prior and codec in half precision; `schedule` is the name of its schedule."""
    tensors: dict[str, Tensor] = {f"denoiser.{key}": value for key, value in model.denoiser.state_dict().items()}
    chain = next(name for name, chain in CHAINS.items() if chain is model.chain)
    architecture: dict[str, Any] = {"schedule": schedule, "chain": chain, "full_density": model.full_density}
    architecture |= {"vocabulary": model.vocabulary.to_json()}
    if isinstance(model.codec, CellCodec):
        codec = model.codec.codec
        tensors |= _fields("codec", codec)
        store_prior(tensors, codec)
        tensors |= _fields("shapes", model.shapes)
        if model.surfaces is not None:
            tensors |= store_surfaces(_fields("surfaces", model.surfaces))
        architecture |= {"kind": "person"}
    else:
        architecture |= {"kind": "slab"}
    if not isinstance(model.denoiser, PersonDenoiser | SlabUNet):
        raise TypeError(f"checkpoints hold a PersonDenoiser or a SlabUNet, not a {type(model.denoiser).__name__}")
    sizes = None if model.denoiser.config is None else dataclasses.asdict(model.denoiser.config)
    architecture["config"] = {"local": sizes} if isinstance(model.denoiser, PersonDenoiser) else sizes
    halved = {key: value.half() if _is_halved(key, value) else value for key, value in tensors.items()}
    card = {key: value for key, value in model.card.items() if key != "sha256"}  # of the file it came from
    metadata = {
        "format": FORMAT,
        "format_version": str(FORMAT_VERSION),
        "architecture": json.dumps(architecture),
        "card": json.dumps(card),
    }
    contents = {key: value.detach().cpu().contiguous().clone() for key, value in halved.items()}
    check_finite(path, contents)
    write_atomically(path, tensor_file.save(contents, metadata=metadata))


def read_checkpoint(path: Path) -> tuple[dict[str, Tensor], ModelConfig, dict[str, Any]]:
    """Return tensors in float32, configuration and card (with the file's SHA-256) of a checkpoint of any kind.

    Raises FileNotFoundError for a missing file and FileError (a ValueError) for one that is truncated, of another
    format or version, or holds values that are not finite.
    """
    tensors, metadata, digest = read_tensors(path, (FORMAT,))
    with mismatches_named(path):
        card = {**parse_json(metadata["card"]), "sha256": digest}
        return tensors, read(ModelConfig, parse_json(metadata["architecture"])), card


def read_tensors(path: Path, formats: Sequence[str]) -> tuple[dict[str, Tensor], dict[str, str], str]:
    """Return tensors in float32, metadata and SHA-256 of a checkpoint or encoder; errors as in `read_checkpoint`."""
    _check_there(path)
    with _damage_named(path):
        file = tensor_file.TensorFile(path)
    _check_format(path, file.metadata, formats)
    with _damage_named(path):
        tensors = file.finite_tensors()
    return {key: value.float() for key, value in tensors.items()}, file.metadata, file_hash(path)


def mismatches_named(path: Path) -> contextlib.AbstractContextManager[None]:
    """Raise FileError for errors caused by tensors that contradict the file's own architecture."""
    return as_file_error(path, "does not match its own description", "download or train it again", RuntimeError)


def file_hash(path: Path) -> str:
    """SHA-256 of a file, as hexadecimal digits."""
    with open_regular(path, tensor_file.LARGEST_FILE) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def read_card(path: Path | str | None = None) -> dict[str, Any]:
    """Return the card of a checkpoint or encoder without reading weights; errors as in `read_checkpoint`.

    A checkpoint's card lists under "attributes" what its model can be conditioned on (`AttributeVocabulary.to_json`).
    """
    path = checkpoint_file(path)
    metadata = read_metadata(path, (FORMAT, ENCODER_FORMAT))
    with mismatches_named(path):
        known = parse_json(metadata.get("architecture", "{}")).get("vocabulary")
        return parse_json(metadata["card"]) | ({"attributes": known} if known else {})


def load_checkpoint(path: Path | str | None = None, device: torch.device | str = "cpu") -> DiffusionModel:
    """Load a model in float32, trained here or imported (`released`), from the file that `checkpoint_file` finds.

        >>> model = pd.load_checkpoint()
        >>> outfits = model.vocabulary.categories["outfit"]

    Raises FileNotFoundError for a missing file and FileError (a ValueError) for one that is truncated, of another
    format or version, does not match its own architecture or holds values that are not finite, and for a user's body
    file that is missing or has changed, which an imported one needs; as `checkpoint_file`.
    """
    path = checkpoint_file(path)
    tensors, config, card = read_checkpoint(path)
    with mismatches_named(path):
        released = config.kind == RELEASED
        model = _released_model(tensors, config, card, path.parent) if released else _model(tensors, config, card)
        return model.to(device)


def _model(tensors: Mapping[str, Tensor], config: ModelConfig, card: Mapping[str, Any]) -> DiffusionModel:
    schedule = SCHEDULES[config.schedule]()
    weights = under(tensors, "denoiser.")
    vocabulary = AttributeVocabulary.from_json(config.vocabulary)
    if config.kind == "slab":
        denoiser: torch.nn.Module = tensor_file.load_network(lambda: SlabUNet(config.unet()), weights)
        codec, shapes, surfaces = WholeSlab(), STANDARD_SHAPES, None
    else:
        stored = under(tensors, "codec.")
        codec = CellCodec(LinearCodec(**{**stored, "region": stored["region"].long()}))
        check_codec(codec.codec)
        restore_prior(weights, codec.codec)
        prior = PersonPrior(**under(weights, "prior_"))
        shapes = ShapePrior(**under(tensors, "shapes."))
        check_parts(codec.codec, prior, shapes, vocabulary)
        surfaces = restore_surfaces(under(tensors, "surfaces."), vocabulary)
        denoiser = tensor_file.load_network(lambda: PersonDenoiser(config.local(), prior, schedule), weights)
    denoiser.eval().requires_grad_(False)
    chain = CHAINS[config.chain]
    density = float(config.full_density)
    return DiffusionModel(denoiser, schedule, codec, shapes, density, card, vocabulary, chain, surfaces=surfaces)


def _released_model(
    tensors: Mapping[str, Tensor], config: ModelConfig, card: Mapping[str, Any], folder: Path
) -> DiffusionModel:
    """Build an imported model; `folder` is that of its file."""
    weights = under(tensors, "denoiser.")
    with tensor_file.ParameterLimit(weights), torch.device("meta"):
        network = SlabUNet(config.unet())
    network.load_state_dict(weights, assign=True)
    network.eval().requires_grad_(False)
    body_setup = stored_body_setup(tensors, config.body, folder)
    if tensors["stand.betas"].shape != (BETAS,):
        raise RuntimeError(f"betas have shape {tuple(tensors['stand.betas'].shape)}, not ({BETAS},)")
    fixed_betas = (
        torch.zeros(BETAS, 0),
        tensors["stand.betas"],
        torch.zeros(BETAS, BETAS),
        torch.full((BETAS,), LARGEST_BETA),
    )
    return DiffusionModel(
        denoiser=network,
        schedule=SCHEDULES[config.schedule](),
        codec=ReleasedSlab(),
        shapes=ShapePrior(*fixed_betas),
        full_density=float(config.full_density),
        card=card,
        chain=CHAINS[config.chain],
        body_setup=body_setup,
    )


def anchor_tensors(anchors: Anchors) -> dict[str, Tensor]:
    """The tensors by which a file stores the anchors on a user's body."""
    return {
        "stand.face": anchors.face,
        "stand.barycentric": anchors.barycentric,
        "stand.rest_half_extent": anchors.rest_half_extent,
    }


def stored_body_setup(tensors: Mapping[str, Tensor], body: str, folder: Path) -> BodySetup:
    """Load the body of a file in `folder` with its `anchor_tensors`; `body` is the JSON of `BodyFiles`.

    Raises FileError if a body file is missing or changed; ValueError if it does not give these anchors; KeyError.
    """
    body_setup = find_body_setup(BodyFiles.from_json(body), tensors["stand.rest_half_extent"], [folder])
    anchors = body_setup.anchors
    if not (
        torch.equal(anchors.face, tensors["stand.face"].long())
        and torch.allclose(anchors.barycentric, tensors["stand.barycentric"], atol=1e-5)
    ):
        raise ValueError("the body gives other anchors than those that it was imported with")
    return body_setup


def read_metadata(path: Path, formats: Sequence[str]) -> dict[str, str]:
    """Return the metadata of a checkpoint or encoder; errors as in `read_checkpoint`."""
    _check_there(path)
    with _damage_named(path):
        metadata = tensor_file.TensorFile(path).metadata
    _check_format(path, metadata, formats)
    return metadata


def _check_there(path: Path) -> None:
    if not path.is_file():
        raise FileNotFoundError(
            f"there is no checkpoint at {path}: give a .safetensors file on this disk, or the folder of a model; "
            "models are not downloaded, so run hf download first"
        )


def _check_format(path: Path, metadata: Mapping[str, str], formats: Sequence[str]) -> None:
    if metadata.get("format") not in formats:
        raise FileError(
            path, f"has the format {metadata.get('format')!r:.40}, not {formats[0]!r}", "choose another file"
        )
    if metadata.get("format_version") != _READABLE[metadata["format"]]:
        version, readable = metadata.get("format_version"), _READABLE[metadata["format"]]
        raise FileError(
            path, f"has format version {version!s:.20}, this program reads {readable}", "use the matching release"
        )


def _damage_named(path: Path) -> contextlib.AbstractContextManager[None]:
    return as_file_error(path, "is damaged or no safetensors file", "download or train it again", OSError)


def check_finite(path: Path, tensors: Mapping[str, Tensor]) -> None:
    """Raise FileError for NaN or infinite values."""
    for key, value in tensors.items():
        if not torch.isfinite(value).all():
            raise FileError(path, f"has NaN or infinite values in {key!r}", "download or train it again")


def _fields(prefix: str, record: TensorRecord) -> dict[str, Tensor]:
    """The tensors of a record by their names in a checkpoint."""
    return {f"{prefix}.{field.name}": getattr(record, field.name) for field in dataclasses.fields(record)}


def _is_halved(key: str, value: Tensor) -> bool:
    return key.startswith(_HALVED) and value.is_floating_point() and value.ndim > 1 and not key.endswith(_WHOLE)


BYTE = 255.0
"""A stored share of 1, or the largest tone."""


def store_surfaces(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """Surfaces with values of voxels in bytes, and shares of boxes that are not whole."""
    in_bytes = {f"surfaces.{name}": tensors[f"surfaces.{name}"] / most for name, most in LARGEST.items()}
    stored = tensors | {key: (value * BYTE).round().to(torch.uint8) for key, value in in_bytes.items()}
    whole = (stored["surfaces.share"] == BYTE).all(1)
    return stored | {"surfaces.whole": whole, "surfaces.share": stored["surfaces.share"][~whole]}


def restore_surfaces(tensors: Mapping[str, Tensor], vocabulary: AttributeVocabulary) -> Surfaces | None:
    """Undo `store_surfaces`; None without any. Raises ValueError, KeyError and TypeError where tensors do not fit."""
    if not tensors:
        return None
    tensors = {**optional_fields(), **tensors}  # earlier checkpoints have neither, and store all shares
    whole = tensors.pop("whole", torch.zeros(len(tensors["cell"]))).bool()
    numbers = {name: tensors[name].long() for name in NUMBERS}
    flags = {name: tensors[name].bool() for name in ("natural", "read", "drawn")}
    of_voxels = {name: tensors[name].float() / BYTE * most for name, most in LARGEST.items()}
    partial, of_voxels["share"] = of_voxels["share"], torch.ones_like(of_voxels["tone"])
    if whole.shape != of_voxels["tone"].shape[:1] or partial.shape != of_voxels["tone"][~whole].shape:
        raise ValueError(f"share has shape {tuple(partial.shape)}, which does not fit the boxes that are not whole")
    of_voxels["share"][~whole] = partial
    surfaces = Surfaces(**{**tensors, **numbers, **flags, **of_voxels})
    check_surfaces(surfaces, vocabulary)
    return surfaces


SYMMETRIC = 1e-4
"""Largest difference between an entry of a person component and its mirror image; entries are up to 1."""
RANK = 1e-5
"""Smallest singular value of the centres of kinds that is kept, as a share of the largest."""
MOST_CENTRES = 2**26
"""Most numbers that factors in a file may be multiplied out to."""


def store_prior(tensors: dict[str, Tensor], codec: LinearCodec) -> None:
    """Replace tensors of a prior, among those of a model, by smaller ones."""
    _store_half(tensors, codec)
    _store_effects(tensors)


def _store_half(tensors: dict[str, Tensor], codec: LinearCodec) -> None:
    """Keep the left half of each person component where the right one is its mirror image times its parity."""
    part, parity = tensors["denoiser.prior_part"], tensors["denoiser.prior_parity"]
    basis = tensors["denoiser.prior_basis"][:, part.argsort(stable=True).argsort()].mT
    half = basis.unflatten(2, (GRID, GRID))[..., : GRID // 2]
    if torch.allclose(_whole_components(half, part, parity, codec), basis, atol=SYMMETRIC):
        del tensors["denoiser.prior_basis"]
        tensors["denoiser.prior_basis_half"] = half


def _store_effects(tensors: dict[str, Tensor]) -> None:
    """Keep the centres of kinds, which are sums of few effects (`training.prior`), as a product of two factors."""
    centre = tensors["denoiser.prior_centre"].flatten(0, 1)
    kinds, size, effects = torch.linalg.svd(centre, full_matrices=False)
    rank = int((size > RANK * size[0]).sum())
    if rank * sum(centre.shape) < centre.numel():
        del tensors["denoiser.prior_centre"]
        root = size[:rank].sqrt()
        tensors["denoiser.prior_kinds"] = kinds[:, :rank] * root
        tensors["denoiser.prior_effects"] = root[:, None] * effects[:rank]


def restore_prior(weights: dict[str, Tensor], codec: LinearCodec) -> None:
    """Undo `store_prior` in the denoiser's tensors of a file.

    Raises ValueError, KeyError and RuntimeError for tensors that do not fit together.
    """
    if "prior_effects" in weights:
        kinds, effects = weights.pop("prior_kinds"), weights.pop("prior_effects")
        if len(kinds) * effects.shape[1] > MOST_CENTRES:
            raise ValueError(f"centres of kinds are {len(kinds)} times {effects.shape[1]} numbers")
        weights["prior_centre"] = (kinds @ effects).unflatten(0, weights["prior_log_weight"].shape)
    for name in ("prior_part", "prior_head"):
        weights[name] = weights[name].long()
    half, part = weights.pop("prior_basis_half", None), weights["prior_part"]
    if half is not None:
        if half.ndim != 4 or half.shape[2:] != (GRID, GRID // 2) or half.shape[1] > codec.channels:
            raise ValueError(f"halves of person components have shape {tuple(half.shape)}")
        whole = _whole_components(half, part, weights["prior_parity"], codec)
        weights["prior_basis"] = whole.mT[:, part.argsort(stable=True)].contiguous()


def _whole_components(
    half: Float[Tensor, "n d 32 16"], part: Int[Tensor, "k"], parity: Float[Tensor, "r"], codec: LinearCodec
) -> Float[Tensor, "n d k"]:
    left = torch.nn.functional.pad(half, (0, GRID // 2))
    if len(parity) % len(half) or not bool(((part >= 0) & (part < len(parity) // len(half))).all()):
        raise ValueError(f"{len(parity)} parities are not those of {len(half)} components of each part")
    signs = parity.unflatten(0, (-1, len(half)))[part].T.unflatten(1, (1, GRID, GRID))
    return (left + signs * codec.mirror(left)).flatten(2)
