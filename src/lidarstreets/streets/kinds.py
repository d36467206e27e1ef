"""The kinds of streets and the typical numbers of each."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Kind:
    """The typical numbers of one kind of street; `draw_style` varies them for each street."""

    # Share of all streets.
    share: float
    # Smallest and largest width of a lane, and chances of 1, 2, 3 lanes in each direction.
    lane: tuple[float, float]
    lanes: tuple[float, float, float]
    # Chances of a long median and of islands in the middle of the road.
    median: float
    islands: float
    # Chance of a parking lane on each side.
    parking: float
    # Chances of the arrangements of strips on each side; their names are those in
    # `_draw_strips` of `styles`.
    sides: dict[str, float]
    # Largest height of the banks.
    relief: float
    # As in `Style`; `parked` and those after it are multiplied by random factors.
    plots: tuple[float, float, float, float, float]
    setback: tuple[float, float]
    storeys: tuple[float, float]
    parked: float
    trees: float
    fenced: float
    traffic: float
    people: float
    green: float
    # Chance that lane markings are painted.
    painted: float
    speed: float = 1.0
    junctions: float = 1.0
    one_way: float = 0.0


KINDS = {
    "residential": Kind(
        share=0.40,
        lane=(2.4, 3.9),
        lanes=(1.0, 0.0, 0.0),
        median=0.0,
        islands=0.05,
        parking=0.21,
        sides={"sidewalk": 0.74, "verge": 0.15, "cycle path": 0.04, "gravel": 0.03, "none": 0.04},
        relief=1.6,
        plots=(0.54, 0.20, 0.15, 0.09, 0.02),
        setback=(2, 9),
        storeys=(3.0, 7.0),
        parked=0.45,
        trees=17.0,
        fenced=0.9,
        traffic=0.5,
        people=1.6,
        green=1.5,
        painted=0.3,
        junctions=1.3,
        one_way=0.12,
    ),
    "living": Kind(
        share=0.08,
        lane=(1.9, 3.0),
        lanes=(1.0, 0.0, 0.0),
        median=0.0,
        islands=0.0,
        parking=0.3,
        sides={"sidewalk": 0.30, "verge": 0.05, "gravel": 0.20, "none": 0.45},
        relief=1.2,
        plots=(0.50, 0.30, 0.10, 0.08, 0.02),
        setback=(1, 6),
        storeys=(3.0, 8.0),
        parked=0.5,
        trees=20.0,
        fenced=0.9,
        traffic=0.2,
        people=2.5,
        green=1.4,
        painted=0.0,
        speed=0.5,
        junctions=1.2,
        one_way=0.3,
    ),
    "urban": Kind(
        share=0.20,
        lane=(3.0, 4.2),
        lanes=(0.8, 0.2, 0.0),
        median=0.05,
        islands=0.2,
        parking=0.33,
        sides={
            "sidewalk": 0.60,
            "verge": 0.15,
            "cycle path": 0.15,
            "paved verge": 0.07,
            "service road": 0.03,
        },
        relief=1.2,
        plots=(0.2, 0.60, 0.11, 0.06, 0.03),
        setback=(0, 3),
        storeys=(6.0, 16.0),
        parked=0.6,
        trees=17.0,
        fenced=0.45,
        traffic=0.9,
        people=4.0,
        green=1.0,
        painted=0.8,
        junctions=1.2,
        one_way=0.15,
    ),
    "avenue": Kind(
        share=0.09,
        lane=(3.0, 3.7),
        lanes=(0.4, 0.5, 0.1),
        median=0.75,
        islands=0.25,
        parking=0.28,
        sides={
            "sidewalk": 0.45,
            "verge": 0.15,
            "cycle path": 0.20,
            "paved verge": 0.05,
            "service road": 0.15,
        },
        relief=1.2,
        plots=(0.1, 0.45, 0.25, 0.15, 0.05),
        setback=(0, 8),
        storeys=(6.0, 20.0),
        parked=0.6,
        trees=15.0,
        fenced=0.5,
        traffic=1.3,
        people=2.5,
        green=1.0,
        painted=0.9,
        speed=1.3,
        junctions=0.9,
    ),
    "rural": Kind(
        share=0.13,
        lane=(2.3, 3.7),
        lanes=(1.0, 0.0, 0.0),
        median=0.0,
        islands=0.03,
        parking=0.0,
        sides={
            "soft verge": 0.40,
            "sidewalk": 0.25,
            "cycle path": 0.17,
            "gravel": 0.08,
            "none": 0.10,
        },
        relief=4.0,
        plots=(0.14, 0.0, 0.54, 0.31, 0.01),
        setback=(5, 15),
        storeys=(3.0, 6.0),
        parked=0.0,
        trees=24.0,
        fenced=0.45,
        traffic=0.5,
        people=0.5,
        green=1.6,
        painted=0.6,
        speed=1.5,
        junctions=0.7,
    ),
    "fast": Kind(
        share=0.04,
        lane=(3.2, 3.8),
        lanes=(0.5, 0.5, 0.0),
        median=0.3,
        islands=0.15,
        parking=0.0,
        sides={"soft verge": 0.45, "shoulder": 0.25, "cycle path": 0.15, "gravel": 0.15},
        relief=5.0,
        plots=(0.02, 0.0, 0.60, 0.37, 0.01),
        setback=(15, 30),
        storeys=(4.0, 9.0),
        parked=0.0,
        trees=28.0,
        fenced=0.6,
        traffic=0.9,
        people=0.1,
        green=1.5,
        painted=1.0,
        speed=2.0,
        junctions=0.4,
    ),
    "motorway": Kind(
        share=0.06,
        lane=(3.5, 3.9),
        lanes=(0.0, 0.6, 0.4),
        median=1.0,
        islands=0.0,
        parking=0.0,
        sides={"shoulder": 0.85, "soft verge": 0.15},
        relief=5.0,
        plots=(0.01, 0.0, 0.60, 0.38, 0.01),
        setback=(20, 30),
        storeys=(4.0, 9.0),
        parked=0.0,
        trees=40.0,
        fenced=0.5,
        traffic=1.4,
        people=0.0,
        green=1.5,
        painted=1.0,
        speed=2.8,
        junctions=0.35,
    ),
}
