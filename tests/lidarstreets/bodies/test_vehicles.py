"""The makers of vehicles and people: plausible sizes, the right classes, on the ground."""

from __future__ import annotations

import numpy as np
import pytest

from lidarstreets.bodies.vehicles import buses, cars, machines, people, trucks, two_wheelers
from lidarstreets.bodies.vehicles.parts import facing_outwards, glass
from lidarstreets.materials import Label, Surface
from lidarstreets.mesh import Maker, Mesh
from lidarstreets.solids import box

from fixtures.examples import first_of

# Per maker: class, smallest and largest length, width and height in metres.
Limits = tuple[float, float]
MAKERS: dict[Maker, tuple[Label, Limits, Limits, Limits]] = {
    cars.car: (Label.CAR, (2.4, 6.4), (1.5, 2.7), (1.0, 3.0)),
    cars.van: (Label.CAR, (4.2, 6.4), (1.7, 2.7), (1.7, 3.0)),
    trucks.truck: (Label.TRUCK, (5.0, 17.5), (1.9, 3.3), (2.0, 4.5)),
    buses.bus: (Label.BUS, (6.0, 19.0), (2.0, 5.0), (2.6, 4.5)),
    buses.tram: (Label.BUS, (12.0, 40.0), (2.0, 2.8), (3.0, 4.0)),
    machines.trailer: (Label.TRAILER, (2.0, 9.0), (1.1, 2.7), (0.6, 3.0)),
    machines.caravan: (Label.TRAILER, (4.0, 9.0), (1.8, 2.7), (2.0, 2.8)),
    machines.machine: (Label.CONSTRUCTION_VEHICLE, (1.4, 9.5), (0.9, 9.5), (1.2, 5.5)),
    machines.excavator: (Label.CONSTRUCTION_VEHICLE, (1.4, 9.5), (0.9, 9.5), (1.2, 5.5)),
    two_wheelers.bicycle: (Label.BICYCLE, (1.2, 2.1), (0.3, 1.0), (0.7, 1.5)),
    two_wheelers.motorcycle: (Label.MOTORCYCLE, (1.4, 2.6), (0.4, 1.2), (0.7, 1.8)),
    two_wheelers.bicyclist: (Label.BICYCLIST, (1.2, 3.2), (0.4, 1.2), (1.3, 2.2)),
    two_wheelers.motorcyclist: (Label.MOTORCYCLIST, (1.4, 2.6), (0.4, 1.2), (1.3, 2.2)),
    people.person: (Label.PERSON, (0.2, 2.2), (0.2, 1.6), (0.6, 2.6)),
    people.sitter: (Label.PERSON, (0.5, 1.6), (0.3, 0.8), (1.0, 1.7)),
}


def size_of(mesh: Mesh) -> np.ndarray:
    size: np.ndarray = np.ptp(mesh.triangles.reshape(-1, 3), axis=0)
    return size


@pytest.mark.parametrize("bodies", first_of((8, 60)))
@pytest.mark.parametrize("maker", MAKERS, ids=lambda maker: maker.__name__)
def test_a_maker_returns_plausible_bodies_on_the_ground(maker: Maker, bodies: int) -> None:
    label, *limits = MAKERS[maker]
    rng = np.random.default_rng(0)
    for _ in range(bodies):
        mesh = maker(rng)
        assert np.isfinite(mesh.triangles).all()
        assert len(mesh) < 2000
        towed = {Label.SEMI_TRAILER} if label == Label.TRUCK else set()
        assert set(np.unique(mesh.label)) <= {label, Label.OTHER_OBJECT} | towed
        assert abs(mesh.triangles[..., 2].min()) < 0.08
        for size, (low, high) in zip(size_of(mesh), limits, strict=True):
            assert low < size < high


def test_a_semi_trailer_stands_behind_its_truck() -> None:
    """nuScenes labels the part behind the tractor unit as a trailer; SemanticKITTI does not."""
    rng = np.random.default_rng(1)
    trailers = 0
    for _ in range(60):
        mesh = trucks.truck(rng)
        is_trailer = mesh.label == Label.SEMI_TRAILER
        if not is_trailer.any():
            continue

        trailers += 1
        x = mesh.triangles[..., 0].mean(axis=1)
        assert x[is_trailer].mean() < x[~is_trailer].mean() - 3
        assert set(np.unique(mesh.label[~is_trailer])) == {Label.TRUCK}

    assert 5 < trailers < 20
    assert Label.SEMI_TRAILER.raw == Label.TRUCK
    assert Label.SEMI_TRAILER.category == Label.TRAILER.category


@pytest.mark.parametrize("maker", [cars.car, trucks.truck, people.person])
def test_bodies_of_one_kind_differ(maker: Maker) -> None:
    rng = np.random.default_rng(0)
    assert len(np.unique(np.array([size_of(maker(rng)) for _ in range(30)]).round(4), axis=0)) == 30


def test_people_of_a_group_stand_close_together() -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        group = people.people_group(rng)
        assert 2 <= len(group) <= 6
        middles = [person.triangles.reshape(-1, 3).mean(axis=0)[:2] for person in group]
        assert np.linalg.norm(np.array(middles), axis=1).max() < 3.5


def test_a_solid_is_turned_to_face_outwards() -> None:
    solid = facing_outwards(box((2, 1, 1), (5, 0, 0)))
    edges = np.diff(solid, axis=1)
    normals = np.cross(edges[:, 0], edges[:, 1])
    outward = solid.mean(axis=1) - solid.reshape(-1, 3).mean(axis=0)
    assert (np.einsum("ti,ti->t", normals, outward) > 0).all()


def test_pulses_pass_clear_glass_only() -> None:
    pane = box((1, 1, 1))
    assert (glass([pane], Label.CAR, clear=True).depth > 0).all()
    assert (glass([pane], Label.CAR, clear=False).depth == 0).all()
    assert (glass([pane], Label.CAR, clear=True).surface == Surface.GLASS).all()
