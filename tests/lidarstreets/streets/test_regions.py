"""Test the regions, whose factors change the shares of streets and of what is in them."""

import dataclasses

import numpy as np
import pytest

from lidarstreets import drive_street
from lidarstreets.materials import Label
from lidarstreets.sensing.sensors import LIDAR_MODELS
from lidarstreets.sites.traffic import VEHICLE_MAKERS
from lidarstreets.streets.kinds import STREET_KINDS
from lidarstreets.streets.regions import REGIONS, Region, scaled
from lidarstreets.streets.styles import draw_style


def test_each_sensor_drives_in_a_region() -> None:
    assert {model.region for model in LIDAR_MODELS.values()} == set(REGIONS)


@pytest.mark.parametrize("region", REGIONS)
def test_factors_name_what_exists(region: str) -> None:
    arrangements = {name for kind in STREET_KINDS.values() for name in kind.sides}
    assert set(REGIONS[region].kinds) <= set(STREET_KINDS)
    assert set(REGIONS[region].sides) <= arrangements
    assert set(REGIONS[region].vehicles) <= set(VEHICLE_MAKERS)


def test_a_factor_scales_one_share() -> None:
    assert scaled({"a": 0.25, "b": 0.5}, {"b": 3.0}) == {"a": 0.25, "b": 1.5}


def test_a_region_changes_how_often_a_kind_of_street_is_drawn() -> None:
    def share_of(kind: str, region: Region) -> float:
        rng = np.random.default_rng(0)
        return float(np.mean([draw_style(rng, region).kind == kind for _ in range(2000)]))

    urban = STREET_KINDS["urban"].share
    doubled = 2 * urban / (1 + urban)
    assert share_of("urban", Region()) == pytest.approx(urban, abs=0.03)
    assert share_of("urban", Region(kinds={"urban": 2.0})) == pytest.approx(doubled, abs=0.03)


def test_nuscenes_streets_have_more_trucks_than_streets_of_kitti() -> None:
    def share_of_trucks(region: str) -> float:
        counts = np.zeros(2)
        model = LIDAR_MODELS["hdl32e"]
        for street in range(12):
            seed = np.random.SeedSequence((5, street))
            (scan,) = drive_street(dataclasses.replace(model, region=region), 1, seed)
            is_truck = np.isin(scan.labels & 0xFFFF, [Label.TRUCK, 258])
            counts += is_truck.sum(), len(is_truck)
        return float(counts[0] / counts[1])

    assert share_of_trucks("boston-singapore") > 1.5 * share_of_trucks("karlsruhe")
