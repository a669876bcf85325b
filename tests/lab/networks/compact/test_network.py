"""The compact network: blind to light and to position, and the same for both pictures of a pair."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from aquaflow.lab.networks.compact.network import (
    COARSE,
    FINE,
    CompactPrior,
    NetworkSize,
    cell_rays,
    coarse_at,
    fine_around,
    locally_normalised,
    size_of,
)

pytestmark = pytest.mark.usefixtures("one_thread")

SMALL = NetworkSize(levels=(4, 6, 8, 10), merged=(10, 8, 6), fine=6, coarse=8, head=4)
WIDTH, HEIGHT = 64, 48


@pytest.fixture(scope="module")
def network() -> CompactPrior:
    torch.manual_seed(0)
    return CompactPrior(SMALL).eval()


def pictures(count: int, height: int = HEIGHT, width: int = WIDTH) -> Tensor:
    return torch.rand(count, 3, height, width, generator=torch.Generator().manual_seed(1))


def cells(count: int = 1) -> tuple[Tensor, Tensor]:
    """Descriptors that are all different, and the rays of their cells."""
    rows, columns = HEIGHT // COARSE, WIDTH // COARSE
    Dc = torch.eye(rows * columns).reshape(1, -1, rows, columns).expand(count, -1, -1, -1)
    K = torch.tensor([[[50.0, 0.0, 30.0], [0.0, 55.0, 25.0], [0.0, 0.0, 1.0]]])
    return Dc, cell_rays(K.expand(count, -1, -1), HEIGHT, WIDTH)


@pytest.mark.parametrize("factor", [1.0, 2.0, 3.0, 4.0])
def test_a_size_has_so_many_times_the_weights_and_is_read_off_them(factor: float) -> None:
    shipped, larger = (CompactPrior(NetworkSize().times(f)) for f in (1.0, factor))
    ratio = sum(p.numel() for p in larger.parameters()) / sum(
        p.numel() for p in shipped.parameters()
    )
    assert ratio == pytest.approx(factor, rel=0.05)
    assert size_of(larger.state_dict()) == larger.size
    assert shipped.size == NetworkSize()
    assert (larger.size.fine, larger.size.coarse) == (shipped.size.fine, shipped.size.coarse)


def test_descriptors_have_unit_length_and_confidence_is_a_probability(
    network: CompactPrior,
) -> None:
    with torch.no_grad():
        D, Dc, C = network.encode(pictures(2))
    assert D.shape == (2, SMALL.fine, HEIGHT // FINE, WIDTH // FINE)
    assert Dc.shape == (2, SMALL.coarse, HEIGHT // COARSE, WIDTH // COARSE)
    for descriptors in (D, Dc):
        assert torch.allclose(descriptors.norm(dim=1), torch.ones(()), atol=1e-5)
    assert C.shape == D[:, 0].shape
    assert 0.0 < float(C.min()) < float(C.max()) < 1.0


def test_light_and_colour_change_no_descriptor(network: CompactPrior) -> None:
    picture = pictures(1)
    gain = torch.tensor([0.5, 0.8, 0.6])[None, :, None, None]
    with torch.no_grad():
        bright, dim = network.encode(picture), network.encode(0.2 + gain * picture)
    assert float((bright.Dc * dim.Dc).sum(1).min()) > 0.999
    assert float((bright.D * dim.D).sum(1).min()) > 0.999


def test_a_plain_picture_is_normalised_to_nothing() -> None:
    assert float(locally_normalised(torch.full((1, 3, 32, 32), 0.7)).abs().max()) < 1e-3


def test_descriptors_do_not_know_where_they_are(network: CompactPrior) -> None:
    wide = pictures(1, 96, 512)
    with torch.no_grad():
        left, right = network.encode(wide[..., :-64]), network.encode(wide[..., 64:])
    moved, reach = 64 // COARSE, 18  # cells that see beyond the pictures' ends
    same = left.Dc[..., moved + reach : -reach], right.Dc[..., reach : -moved - reach]
    assert same[0].shape[-1] > 5
    assert torch.allclose(*same, atol=1e-4)


def test_cells_find_themselves_and_say_so(network: CompactPrior) -> None:
    comparison = CompactPrior(NetworkSize(coarse=48, head=4)).eval().comparison
    comparison.sharpness.data.fill_(4.6)
    Dc, rays = cells()
    with torch.no_grad():
        one, other = comparison(Dc, Dc, rays, rays)
    centre = (torch.arange(WIDTH // COARSE) + 0.5) * COARSE
    assert torch.allclose(one.pixels[0, 0], centre.expand_as(one.pixels[0, 0]), atol=1e-2)
    assert torch.allclose(one.ray, rays, atol=1e-3)
    assert torch.allclose(one.ray, other.ray)
    assert float(one.score.min()) > 0.999


def test_what_is_seen_one_cell_further_is_said_to_be(network: CompactPrior) -> None:
    comparison = CompactPrior(NetworkSize(coarse=48, head=4)).eval().comparison
    comparison.sharpness.data.fill_(4.6)
    Dc, rays = cells()
    with torch.no_grad():
        there, back = comparison(Dc, Dc.roll(1, -1), rays, rays)
    assert torch.allclose(there.pixels[0, 0, :, 0], torch.tensor(1.5 * COARSE), atol=1e-2)
    assert torch.allclose(back.pixels[0, 0, :, 1], torch.tensor(0.5 * COARSE), atol=1e-2)
    assert torch.allclose(there.ray[..., :-1], rays[..., 1:], atol=1e-3)


def test_exchanging_the_pictures_exchanges_the_answers(network: CompactPrior) -> None:
    with torch.no_grad():
        a, b = (network.encode(picture) for picture in pictures(2).split(1))
        rays = torch.rand(2, 1, 2, *a.Dc.shape[-2:], generator=torch.Generator().manual_seed(2))
        one, other = network.comparison(a.Dc, b.Dc, rays[0], rays[1])
        other_again, one_again = network.comparison(b.Dc, a.Dc, rays[1], rays[0])
    for said, again in zip((*one, *other), (*one_again, *other_again), strict=True):
        assert torch.allclose(said, again, atol=1e-5)


def test_a_cell_s_ray_goes_through_its_centre() -> None:
    K = torch.tensor([[[50.0, 0.0, 30.0], [0.0, 55.0, 25.0], [0.0, 0.0, 1.0]]])
    rays = cell_rays(K, HEIGHT, WIDTH)
    assert rays[0, :, 2, 3].tolist() == pytest.approx([(28.0 - 30.0) / 50.0, (20.0 - 25.0) / 55.0])


def test_pixels_move_as_their_cell_does() -> None:
    pixels = torch.zeros(1, 2, 2, 2)
    pixels[0, :, 1, 0] = torch.tensor([30.0, 40.0])  # cell whose centre is (4, 12)
    found = coarse_at(pixels, torch.tensor([[[5.0, 10.0]]]))
    assert found[0, 0].tolist() == [31.0, 38.0]


@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.7, -0.6), (5.3, 7.4), (-9.0, 3.9)])
def test_fine_descriptors_find_the_fraction_of_a_pixel(shift: tuple[float, float]) -> None:
    def field(dx: float, dy: float) -> Tensor:
        """Smooth descriptors of a scene that moved by (dx, dy) px."""
        y, x = torch.meshgrid(torch.arange(40.0), torch.arange(50.0), indexing="ij")
        x, y = ((x + 0.5) * FINE - dx) / 100.0, ((y + 0.5) * FINE - dy) / 100.0
        waves = [f * math.pi * v for f in (0.5, 1.0, 2.0, 4.0) for v in (x, y)]
        parts = [part for wave in waves for part in (wave.sin(), wave.cos())]
        return torch.nn.functional.normalize(torch.stack(parts)[None], dim=1)

    places = torch.tensor([[[40.0, 40.0], [51.0, 37.0], [60.5, 44.2]]])
    found, product = fine_around(field(0.0, 0.0), field(*shift), places, places)
    assert torch.allclose(found, places + torch.tensor(shift), atol=0.1)
    assert float(product.min()) > 0.99


def test_beyond_the_picture_nothing_is_found() -> None:
    D = torch.nn.functional.normalize(torch.rand(1, 4, 10, 10), dim=1)
    places = torch.tensor([[[1.0, 1.0], [19.0, 19.0]]])
    found, _ = fine_around(D, D, places, places)
    assert float(found.min()) >= 0.0
    assert float(found.max()) <= 20.0
