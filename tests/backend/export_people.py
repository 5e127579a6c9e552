"""A person of plain boxes for tests of exports: a full body under a colour for each of its sides."""

import functools

import torch
from primdiffusion.export.proxy import MeshProxy, mesh_proxy
from primdiffusion.formats.requests import ProxySettings
from primdiffusion.human import Human, place
from primdiffusion.primitives.primitives import K, Payload, Primitives, S

SMALL = ProxySettings(spacing=0.012, triangles=4000, texture_px=256)


@functools.cache
def person() -> Human:
    """Matter up to 12 mm above the body, red on the left, blue on the right."""
    density = torch.zeros(K, S, S, S)
    density[:, : S // 2 + 1] = 100.0
    payload = Payload(torch.full((K, 3, S, S, S), 0.1), density, torch.ones(K, 3))
    human = Human(payload, torch.zeros(10), {"seed": 1})
    left = place(human).position[:, 0] > 0
    payload.rgb[left, 0], payload.rgb[~left, 2] = 0.8, 0.8
    return human


@functools.cache
def proxy() -> MeshProxy:
    """Their mesh, coarse."""
    return mesh_proxy(person(), SMALL)


def ball(radius: float = 0.3, hollow: float = 0.0, centre: tuple[float, ...] = (0.0, 0.0, 0.0)) -> Primitives:
    """One box with a ball in it, of density 100 and colour (0.2, 0.4, 0.6), empty within `hollow`."""
    axis = torch.linspace(-1, 1, 24) * 0.5
    z, y, x = torch.meshgrid(axis, axis, axis, indexing="ij")
    away = torch.stack([x, y, z]).norm(dim=0)
    density = 100.0 * ((radius - away) / 0.05 + 0.5).clamp(0, 1) * ((away - hollow) / 0.05 + 0.5).clamp(0, 1)
    rgb = torch.tensor([0.2, 0.4, 0.6])[None, :, None, None, None].expand(1, 3, 24, 24, 24).contiguous()
    place = torch.tensor([centre])
    return Primitives(place, torch.eye(3)[None], torch.full((1, 3), 0.5), rgb, density[None])
