"""FID, FID_CLIP and KID against torch-fidelity 0.4: itself where it is installed, and its figures everywhere.

It is no package of the tests: it needs torchvision, and torchmetrics does not load where that does not. To compare with
it: pip install --no-deps --target FOLDER torch-fidelity; PYTHONPATH=FOLDER python -m pytest FILE
"""

import importlib
import sys
import types
from pathlib import Path

import pytest
import torch
from primdiffusion.evaluation.metrics import frechet_distance, kernel_distance_of_subsets
from primdiffusion.evaluation.pretrained_networks import CLIP_NAMES, ClipVision, Inception, load_inception


@pytest.fixture(scope="module")
def torch_fidelity():
    """The package, with what it uses of torchvision where that does not load."""
    try:
        importlib.import_module("torchvision")
    except (ImportError, RuntimeError):
        names = ("torchvision", "torchvision.datasets", "torchvision.transforms", "torchvision.transforms.functional")
        stubs = {name: types.ModuleType(name) for name in (*names, "torchvision.models")}
        for dataset in ("CIFAR10", "STL10", "CIFAR100"):
            setattr(stubs[names[1]], dataset, object)
        for name, stub in stubs.items():
            if "." in name:
                setattr(stubs[name.rpartition(".")[0]], name.rpartition(".")[2], stub)
        stubs[names[3]].normalize = lambda x, mean, std, inplace: (
            (x - torch.tensor(mean)[:, None, None]) / torch.tensor(std)[:, None, None]
        )
        with pytest.MonkeyPatch.context() as patch:
            for name, stub in stubs.items():
                patch.setitem(sys.modules, name, stub)
            found = pytest.importorskip("torch_fidelity", reason="pip install --no-deps torch-fidelity")
            yield found
            return
    yield pytest.importorskip("torch_fidelity", reason="pip install --no-deps torch-fidelity")


@pytest.fixture(scope="module")
def weights_file(tmp_path_factory):
    return save_random_inception(tmp_path_factory.mktemp("weights") / "inception.pth")


def save_random_inception(path: Path) -> Path:
    """Random weights that keep the size of the signal, in torch-fidelity's layout."""
    generator = torch.Generator().manual_seed(0)
    weights = Inception().state_dict()
    for name, value in weights.items():
        if value.ndim == 4:
            value.normal_(0, (2 / value[0].numel()) ** 0.5, generator=generator)
        elif name.endswith(("running_var", "bn.weight")):
            value.uniform_(0.5, 1.5, generator=generator)
        elif value.is_floating_point():
            value.normal_(0, 0.1, generator=generator)
    torch.save({**weights, "fc.weight": torch.zeros(1008, 2048), "fc.bias": torch.zeros(1008)}, path)
    return path


@pytest.fixture(scope="module")
def pictures():
    return random_pictures()


def random_pictures() -> list[torch.Tensor]:
    """Two sets, uint8 [n, 64, 64, 3]."""
    generator = torch.Generator().manual_seed(1)
    return [
        torch.randint(0, most, (count, 64, 64, 3), generator=generator, dtype=torch.uint8)
        for count, most in ((6, 256), (5, 200))
    ]


@pytest.fixture(scope="module")
def features(weights_file, pictures):
    return features_of(weights_file, pictures)


def features_of(weights_file: Path, pictures: list[torch.Tensor]) -> list[torch.Tensor]:
    network = load_inception(weights_file)
    return [network(part.float() / 255) for part in pictures]


def fid_error(weights_file: Path) -> float:
    """Relative difference of our FID of `random_pictures` from torch-fidelity's."""
    return abs(frechet_distance(*features_of(weights_file, random_pictures())) / GIVEN_FID - 1)


def test_figures_are_those_that_torch_fidelity_gave(features):
    first, second = features
    assert first[0, :4].tolist() == pytest.approx(GIVEN_FEATURES, abs=1e-4)
    assert frechet_distance(first, second) == pytest.approx(GIVEN_FID, rel=1e-5)
    kid = kernel_distance_of_subsets(first, second, subsets=7, size=4, seed=2020)
    assert (kid.mean, kid.std) == pytest.approx(GIVEN_KID, rel=1e-4)


def test_inception_features_and_distances_equal_torch_fidelitys(torch_fidelity, weights_file, pictures, features):
    theirs = torch_fidelity.FeatureExtractorInceptionV3("i", ["2048"], feature_extractor_weights_path=str(weights_file))
    given = [theirs(part.movedim(-1, 1))[0] for part in pictures]
    for ours, own in zip(features, given, strict=True):
        assert (ours - own).abs().max() < 1e-4
    fid = importlib.import_module("torch_fidelity.metric_fid")
    kid = importlib.import_module("torch_fidelity.metric_kid")
    statistics = [fid.fid_features_to_statistics(part) for part in given]
    own_fid = fid.fid_statistics_to_metric(*statistics, verbose=False)["frechet_inception_distance"]
    assert frechet_distance(*features) == pytest.approx(own_fid, rel=1e-5)
    settings = {"kid_kernel": "poly", "kid_kernel_poly_degree": 3, "kid_kernel_poly_gamma": None}
    own_kid = kid.kid_features_to_metric(
        *given, kid_subsets=7, kid_subset_size=4, kid_kernel_poly_coef0=1, rng_seed=2020, verbose=False, **settings
    )
    assert kernel_distance_of_subsets(*features, 7, 4, 2020) == pytest.approx(tuple(own_kid.values()), rel=1e-4)


def test_clip_features_equal_torch_fidelitys(torch_fidelity, pictures):
    torch.manual_seed(0)
    ours = ClipVision()
    ours.load_state_dict({name: value.half().float() for name, value in ours.state_dict().items()})  # as published
    clip = importlib.import_module("torch_fidelity.feature_extractor_clip")
    theirs = clip.VisionTransformer(224, 32, 768, 12, 12, 512).eval()
    names = {own: given for given, own in CLIP_NAMES.items()} | {"linear1": "mlp.c_fc", "linear2": "mlp.c_proj"}
    weights = ours.state_dict().items()
    theirs.load_state_dict({".".join(names.get(part, part) for part in name.split(".")): v for name, v in weights})
    extractor = clip.FeatureExtractorCLIP.__new__(clip.FeatureExtractorCLIP)
    torch.nn.Module.__init__(extractor)
    extractor.model = torch.nn.Module()
    extractor.model.visual = theirs
    extractor.resolution, extractor.features_list = 224, ["clip"]
    extractor.feature_extractor_internal_dtype = torch.float32
    with torch.inference_mode():
        given = extractor(pictures[0][:2].movedim(-1, 1))[0]
        assert (ours(pictures[0][:2].float() / 255) - given).abs().max() < 1e-4


GIVEN_FEATURES = [0.0008527947, 0.0130186183, 0.0477054007, 9.2452802658]
GIVEN_FID = 2579.1135469
GIVEN_KID = (1830.1682361, 45.5218106)
"""Of torch-fidelity 0.4.0 for `weights_file` and `pictures`."""
