"""Test the regions, whose factors change the shares of streets and of what is in them."""

import numpy as np
import pytest

from lidarstreets.bodies.vehicles import trucks
from lidarstreets.sensing.sensors import LIDAR_MODELS
from lidarstreets.sites.site import Site
from lidarstreets.sites.traffic import VEHICLE_MAKERS, VEHICLE_SHARES, choose_vehicle
from lidarstreets.streets.ground import Ground
from lidarstreets.streets.kinds import STREET_KINDS
from lidarstreets.streets.regions import REGIONS, Region
from lidarstreets.streets.styles import draw_style


def test_each_sensor_drives_in_a_region_or_in_any_of_them() -> None:
    assert {model.region for model in LIDAR_MODELS.values()} <= {"", *REGIONS}


@pytest.mark.parametrize("region", REGIONS)
def test_factors_name_what_exists(region: str) -> None:
    arrangements = {name for kind in STREET_KINDS.values() for name in kind.sides}
    assert set(REGIONS[region].kinds) <= set(STREET_KINDS)
    assert set(REGIONS[region].sides) <= arrangements
    assert set(REGIONS[region].vehicles) <= set(VEHICLE_MAKERS)


def test_a_region_changes_how_often_a_kind_of_street_is_drawn() -> None:
    def share_of(kind: str, region: Region) -> float:
        rng = np.random.default_rng(0)
        return float(np.mean([draw_style(rng, region).kind == kind for _ in range(1000)]))

    urban = STREET_KINDS["urban"].share
    doubled = 2 * urban / (1 + urban)
    assert share_of("urban", Region()) == pytest.approx(urban, abs=0.03)
    assert share_of("urban", Region(kinds={"urban": 2.0})) == pytest.approx(doubled, abs=0.03)


def test_a_region_changes_how_often_a_kind_of_vehicle_is_drawn() -> None:
    def share_of_trucks(region: Region) -> float:
        rng = np.random.default_rng(0)
        site = Site(Ground(draw_style(rng, region), 120.0, rng, (40.0, 80.0)), rng)
        makers = [choose_vehicle(site, "parked") for _ in range(2000)]
        return makers.count(trucks.truck) / len(makers)

    truck = VEHICLE_SHARES["parked"]["truck"] / sum(VEHICLE_SHARES["parked"].values())
    tripled = 3 * truck / (1 + 2 * truck)
    assert share_of_trucks(Region()) == pytest.approx(truck, abs=0.02)
    assert share_of_trucks(Region(vehicles={"truck": 3.0})) == pytest.approx(tripled, abs=0.02)
