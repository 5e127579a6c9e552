import dataclasses
import hashlib
import json

import pytest
import torch
from diffusion_people import COMPONENTS, VOCABULARY, small_model
from primdiffusion.diffusion.checkpoint import default_checkpoint, load_checkpoint, read_card, save_checkpoint
from primdiffusion.diffusion.codec import WholeSlab
from primdiffusion.diffusion.denoiser import PersonDenoiser
from primdiffusion.diffusion.model import DiffusionModel, sample, unfollowed, warnings_of
from primdiffusion.diffusion.pretrained import model_card, save_pretrained
from primdiffusion.diffusion.schedule import early_steps, linear, trailing_steps
from primdiffusion.diffusion.unet import SlabUNet, UNetConfig
from primdiffusion.editing.vary import vary
from primdiffusion.files.regular_files import FileError
from primdiffusion.human import generate
from primdiffusion.primitives.primitives import GRID, K
from safetensors import safe_open
from safetensors.torch import save_file
from support.errors import refused
from support.tiny import model_of_two_kinds, save_tiny_checkpoint, tiny_model

LEVELS = ("50", "100", "300", "500", "700", "900")


@pytest.fixture
def path(tmp_path):
    path = tmp_path / "model.safetensors"
    save_checkpoint(path, small_model(), "linear")
    return path


def rewrite(path, change_tensors=lambda t: t, change_metadata=lambda m: m):
    with safe_open(path, framework="pt") as file:
        tensors, metadata = {k: file.get_tensor(k) for k in file.keys()}, file.metadata()  # noqa: SIM118
    save_file(change_tensors(tensors), path, change_metadata(metadata))


def test_a_saved_model_generates_the_same_people(path):
    model, loaded = small_model(), load_checkpoint(path)
    x, t = torch.randn(2, 4, 32, 32), 300
    assert torch.allclose(loaded.denoise(x, t), model.denoise(x, t), atol=0.02)
    assert loaded.full_density == 100.0
    card = {"name": "small", "licence": "CC0-1.0"}
    assert read_card(path) == {**card, "attributes": VOCABULARY.to_json()}
    assert loaded.card == {**card, "sha256": hashlib.sha256(path.read_bytes()).hexdigest()}
    again = path.with_name("again.safetensors")
    save_checkpoint(again, loaded, "linear")
    assert torch.equal(load_checkpoint(again).denoise(x, t), loaded.denoise(x, t))


def test_the_steps_that_a_model_is_sampled_in_are_part_of_it(path):
    assert load_checkpoint(path).chain is trailing_steps
    save_checkpoint(path, dataclasses.replace(small_model(), chain=early_steps), "linear")
    assert load_checkpoint(path).chain is early_steps


def test_symmetric_person_components_are_stored_by_half(path):
    model = small_model()
    denoiser, codec = model.denoiser, model.codec.codec
    pictures = torch.randn(len(denoiser.prior_parity), *model.codec.shape)
    denoiser.prior_parity[::2] = -1.0
    codec.parity[0, 1] = -1.0
    signs = denoiser.prior_parity[:, None, None, None]
    symmetric = torch.nn.functional.normalize((pictures + signs * codec.mirror(pictures)).flatten(1), dim=1)
    sizes = []
    for basis in (denoiser.prior_basis.clone(), in_cells(symmetric)):
        denoiser.prior_basis.copy_(basis)
        save_checkpoint(path, model, "linear")
        sizes.append(path.stat().st_size)
        assert torch.allclose(load_checkpoint(path).denoiser.prior_basis, basis, atol=1e-4)
    assert sizes[0] - sizes[1] == pytest.approx(basis.numel(), abs=200)


def in_cells(rows: torch.Tensor) -> torch.Tensor:
    """Rows of components of the whole body as `PersonPrior.basis`."""
    return rows.unflatten(1, (-1, K)).mT


def test_components_of_parts_are_stored_by_half_and_read_again(path):
    model = small_model()
    denoiser, codec = model.denoiser, model.codec.codec
    codec.parity[0, 1] = -1.0
    denoiser.prior_part[:] = (torch.arange(GRID)[:, None] % 2).expand(GRID, GRID).flatten()
    order = denoiser.prior_part.argsort(stable=True)
    pictures = torch.randn(COMPONENTS // 2, *model.codec.shape)
    parity = torch.tensor([1.0, -1.0, 1.0, -1.0, -1.0, 1.0])
    signs = parity.view(2, -1)[denoiser.prior_part].T.reshape(-1, 1, GRID, GRID)
    whole = (pictures + signs * codec.mirror(pictures)) / 100
    basis = in_cells(whole.flatten(1))[:, order].contiguous()
    prior = dataclasses.replace(denoiser.prior, basis=basis, parity=parity)
    model = dataclasses.replace(model, denoiser=PersonDenoiser(None, prior, model.schedule))
    save_checkpoint(path, model, "linear")
    read = load_checkpoint(path).denoiser.prior
    with safe_open(path, framework="pt") as file:
        assert "denoiser.prior_basis_half" in file.keys()  # noqa: SIM118
    for field in dataclasses.fields(prior):
        assert torch.allclose(getattr(read, field.name), getattr(prior, field.name), atol=1e-2), field.name


def test_centres_that_are_sums_of_few_effects_are_stored_as_factors(path):
    model = small_model()
    centre = model.denoiser.prior_centre
    effects = torch.outer(torch.arange(centre[..., 0].numel()) + 1.0, torch.linspace(-3, 2, COMPONENTS))
    centre.copy_(effects.view_as(centre))
    save_checkpoint(path, model, "linear")
    with safe_open(path, framework="pt") as file:
        assert "denoiser.prior_centre" not in file.keys()  # noqa: SIM118
    assert torch.allclose(load_checkpoint(path).denoiser.prior.centre, centre, rtol=2e-3)
    rewrite(path, lambda t: t | {"denoiser.prior_kinds": torch.zeros(2**24, 1)})
    with refused(FileError, path.name, str(2**24)):
        load_checkpoint(path)
    rewrite(path, lambda t: {key: value for key, value in t.items() if key != "denoiser.prior_kinds"})
    with refused(FileError, path.name, "prior_kinds"):
        load_checkpoint(path)


def test_a_slab_network_is_saved_and_loaded(tmp_path):
    torch.manual_seed(0)
    network = SlabUNet(UNetConfig(width=32, multipliers=(1, 1), blocks=1, heads=2))
    torch.nn.init.normal_(network.out[2].weight, std=0.1)
    schedule, path = linear(), tmp_path / "slab.safetensors"
    model = DiffusionModel(network, schedule, WholeSlab(), small_model().shapes, 25.5, {})
    save_checkpoint(path, model, "linear")
    x = torch.randn(1, 56, 16, 16)
    loaded = load_checkpoint(path)
    assert torch.allclose(loaded.denoise(x, 5), model.denoise(x, 5), atol=0.02)
    assert loaded.codec.shape == (56, 256, 256)


@pytest.mark.parametrize(("entry", "text"), [("format", "pt"), ("format_version", "99")])
def test_a_file_of_another_kind_or_version_is_rejected(path, entry, text):
    rewrite(path, change_metadata=lambda m: m | {entry: text})
    with refused(FileError, text):
        load_checkpoint(path)


@pytest.mark.parametrize(
    ("changes", "local"),
    [
        ({"full_density": -200.0}, {}),
        ({"full_density": "200"}, {}),
        ({"vocabulary": {"categories": "sex", "scalars": {}}}, {}),
        ({"vocabulary": {"categories": {}, "scalars": {"height": [1.7]}}}, {}),
        *(({}, larger) for larger in ({"blocks": 10**9}, {"widths": [10**6]}, {"condition_width": 10**15})),
    ],
)
def test_an_impossible_architecture_and_a_network_larger_than_its_file_are_rejected(path, changes, local):
    def change(metadata):
        architecture = json.loads(metadata["architecture"]) | changes
        architecture["config"]["local"] |= local
        return metadata | {"architecture": json.dumps(architecture)}

    rewrite(path, change_metadata=change)
    with refused(FileError):
        load_checkpoint(path)


def test_an_unfinished_model_is_not_saved(tmp_path):
    model = small_model()
    model.denoiser.local.outer.bias.fill_(float("inf"))
    with refused(FileError, "NaN"):
        save_checkpoint(tmp_path / "bad.safetensors", model, "linear")
    assert list(tmp_path.iterdir()) == []


@pytest.fixture(scope="module")
def default():
    return load_checkpoint()


def test_the_default_checkpoint_is_small_and_says_what_it_is(default):
    assert default_checkpoint().stat().st_size <= 96_000_000
    assert {"licence", "data", "full_density", "seed", "steps", "device", "version"} <= default.card.keys()
    assert default.full_density == default.card["full_density"]


def test_the_default_card_s_claim_follows_from_its_numbers(default):
    errors = default.card["held_out_rms_x0_error"]
    better = all(errors["denoiser"][level] < errors["gaussian"][level] for level in LEVELS)
    assert better is default.card["beats_gaussian_at_every_level"]
    assert errors["denoiser"]["300"] < 0.9 * errors["gaussian"]["300"]


def test_the_default_checkpoint_draws_people_that_differ(default):
    people = [list(sample(default, [seed], 5))[-1].x0 for seed in (1, 2)]
    payloads = [default.decode(x0).validate() for x0 in people]
    filled = [(payload.density > 0.5 * default.full_density).float().mean().item() for payload in payloads]
    assert all(0.2 < share < 0.8 for share in filled)
    assert (payloads[0].rgb - payloads[1].rgb).abs().mean() > 0.02


def test_the_committed_model_card_is_the_checkpoint_s(request):
    page = request.config.rootpath / "docs" / "model_card.md"
    assert page.read_text() == model_card(read_card())


MODEL = model_of_two_kinds()


@pytest.mark.parametrize("seed", range(4))
def test_a_combination_that_no_training_human_has_is_named(seed):
    asked = {"sex": "female", "outfit": "suit"}
    made = generate(MODEL, seed, 3, attributes=asked).provenance
    assert made["unfollowed"] in ({"sex": "male"}, {"outfit": "jeans"})
    (warning,) = warnings_of(made)
    ((name, shown),) = made["unfollowed"].items()
    assert f"{name} {asked[name]!r} ({shown!r} instead)" in warning
    assert len(warning) < 300


@pytest.mark.parametrize("asked", [{}, {"sex": "male"}, {"sex": "female", "outfit": "jeans"}])
def test_what_was_followed_is_not_named(asked):
    made = generate(MODEL, 1, 3, attributes=asked).provenance
    assert "unfollowed" not in made
    assert warnings_of(made) == []


def test_a_variant_that_stays_as_it_was_is_named():
    woman = generate(MODEL, 1, 3, attributes={"sex": "female"})
    made = vary(MODEL, woman, 0.05, 2, 3, attributes={"sex": "male"}).provenance["edits"][-1]
    assert made["unfollowed"] == {"sex": "female"}
    assert "sex 'male' ('female' instead)" in warnings_of(made)[0]


def test_a_model_without_kinds_reads_nothing():
    x0 = torch.zeros(2, *MODEL.codec.shape)
    prior = dataclasses.replace(MODEL.denoiser.prior, kind=torch.zeros(1, 2, 0))
    for denoiser in (torch.nn.Identity(), PersonDenoiser(None, prior, MODEL.schedule)):
        model = dataclasses.replace(MODEL, denoiser=denoiser)
        assert unfollowed(model, x0, {"sex": "female"}) == [{}, {}]


def drawn(model):
    *_, last = sample(model, [3], steps=2)
    return last.x0


def test_a_saved_folder_loads_as_the_same_model(tmp_path):
    loaded = load_checkpoint(save_tiny_checkpoint(tmp_path / "tiny.safetensors"))
    folder = save_pretrained(loaded, tmp_path / "folder")
    assert sorted(path.name for path in folder.iterdir()) == ["README.md", "config.json", "model.safetensors"]
    again = load_checkpoint(folder)
    assert torch.equal(drawn(again), drawn(loaded))
    assert again.vocabulary == loaded.vocabulary
    config = json.loads((folder / "config.json").read_text())
    assert (config["library_name"], config["kind"], config["schedule"]) == ("primdiffusion", "person", "linear")
    card = (folder / "README.md").read_text()
    assert card.startswith("---\nlibrary_name: primdiffusion\nlicense: other\n")
    assert "# Model card: tiny" in card


def test_the_readme_is_the_card_of_the_default_checkpoint(default, tmp_path):
    folder = save_pretrained(default, tmp_path / "default")
    card = (folder / "README.md").read_text()
    assert "license: cc0-1.0" in card
    assert card.split("---\n", 2)[2].split("sha256")[0] == model_card(read_card()).split("sha256")[0]


def test_a_snapshot_of_a_hub_cache_whose_files_are_links_loads_and_a_folder_without_a_model_is_refused(tmp_path):
    blob, snapshot = save_tiny_checkpoint(tmp_path / "blobs" / "weights"), tmp_path / "snapshots" / "0123abc"
    snapshot.mkdir(parents=True)
    with refused(FileError, str(snapshot)):
        load_checkpoint(snapshot)
    (snapshot / "model.safetensors").symlink_to(blob)
    assert load_checkpoint(snapshot).card["name"] == "tiny"


def test_a_name_on_the_hub_is_not_downloaded():
    with refused(FileNotFoundError, "download"):
        load_checkpoint("owner/name")


def test_models_that_a_folder_cannot_hold_are_refused_and_leave_nothing(tmp_path):
    levels = dataclasses.replace(linear(), alpha_bar=linear().alpha_bar * 0.9)
    unnamed = dataclasses.replace(tiny_model(), schedule=levels)
    imported = dataclasses.replace(tiny_model(), body_setup=object())
    for model, word in ((unnamed, "no name"), (imported, "your body file")):
        with refused(ValueError, word):
            save_pretrained(model, tmp_path / "folder")
    assert not (tmp_path / "folder").exists()
