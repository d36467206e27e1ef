"""Training on several datasets, and from weights."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

from amvnet.config.recipes import load_recipe
from amvnet.config.schema import AugmentConfig, Recipe
from amvnet.data.datasets import simulated
from amvnet.data.datasets.open import open_dataset
from amvnet.data.datasets.own import OwnScans, open_own
from amvnet.data.datasets.semantickitti import SemanticKitti
from amvnet.data.datasets.training_data import Source, TrainingData, to_mix_in, to_train
from amvnet.data.recordings import ScanFile
from amvnet.data.taxonomy import NUSCENES, SEMANTICKITTI
from amvnet.errors import InputError
from amvnet.models.views.points import PointBatch
from amvnet.models.views.range_view import RangeView
from amvnet.sensors.expectation import Expectation
from amvnet.sensors.lidars import Sensor
from amvnet.sensors.normalise import Normaliser, normalised
from amvnet.training import checking
from amvnet.training.augment import mix
from amvnet.training.checking import check_data
from amvnet.training.expectation import expectation_of
from amvnet.training.loaders import ScanSet, collate
from amvnet.training.losses import rival_classes
from amvnet.training.plan import Plan, open_for_training, sized_by_init, without_initial_weights
from amvnet.weights.file import Weights, load, save

from fixtures import tiny
from fixtures.commands import fails, new_file, not_none, refusal, refused, run_cli, succeed
from fixtures.own_scans import make_own_scans
from fixtures.tiny import fake_drive, fresh_weights, make_streets, write_recipe


def relabel_cars(data: Path) -> None:
    """Call the cars of a dataset buildings, so that it lacks cars."""
    for path in data.rglob("*.label"):
        raw = np.fromfile(path, np.uint32)
        raw[raw == tiny.CAR] = tiny.BUILDING
        raw.tofile(path)


def mixed(tmp_path: Path, share: float, first: int = 4, second: int = 14) -> TrainingData:
    a = open_dataset(str(make_streets(tmp_path / "a", ("00", "08"), first)))
    b = open_dataset(str(make_streets(tmp_path / "b", ("00",), second)))
    sources = [Source(a, a.records(["00"]), a.records(["08"])), Source(b, b.records(["00"]))]
    return TrainingData(sources, share)


def test_without_a_share_every_scan_is_in_every_epoch(tmp_path: Path) -> None:
    data = mixed(tmp_path, 0)
    assert len(data) == len(data.train) == 4 + 14
    for epoch in range(3):
        assert len({record.name for record in data.in_epoch(1, epoch)}) == 14


@pytest.mark.parametrize("share", [0.2, 0.5, 0.75])
def test_a_share_is_that_of_an_epoch(tmp_path: Path, share: float) -> None:
    data = mixed(tmp_path, share)
    assert data.places[1] / len(data) == pytest.approx(share, abs=0.05)
    assert [record.sequence for record in data.val] == ["08"] * 4


def test_all_scans_of_a_mixed_dataset_take_equally_many_turns(tmp_path: Path) -> None:
    data = mixed(tmp_path, 0.5)
    counts: Counter[str] = Counter()
    for epoch in range(14 // 2):  # the lowest number of epochs that is a multiple for 4 places
        counts.update(record.name for record in data.in_epoch(1, epoch))
    assert (len(counts), set(counts.values())) == (14, {2})


def test_a_mixed_scan_is_read_from_its_own_dataset(tmp_path: Path) -> None:
    data = mixed(tmp_path, 0)
    expected = open_dataset(str(tmp_path / "b")).read(data.in_epoch(1, 2)[3])
    scan = data.read(4 + 3, epoch=2)
    np.testing.assert_array_equal(scan.points, expected.points)
    np.testing.assert_array_equal(scan.labels, expected.labels)


def test_points_keep_their_dataset_as_their_source_when_scans_are_mixed(tmp_path: Path) -> None:
    data = mixed(tmp_path, 0.5)
    parts = []
    for index, label in ((0, 3), (len(data) - 1, 9)):
        scan = data.read(index)
        parts.append(replace(scan, labels=np.full(len(scan), label, np.uint8)))
    _, labels, source = collate([mix(parts[0], parts[1], np.random.default_rng(0))])
    assert set(zip(labels.tolist(), source.tolist(), strict=True)) == {(3, 0), (9, 1)}


def test_the_check_finds_others_classes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    relabel_cars(make_streets(tmp_path / "a", ("00", "08"), 4))
    a = open_dataset(str(tmp_path / "a"))
    b = open_dataset(str(make_streets(tmp_path / "b", ("00",), 14)))
    lines: list[str] = []
    data = TrainingData([Source(each, each.records(["00"])) for each in (a, b)], 0.5)
    plan = Plan(load_recipe("semantickitti-compact"), data, tmp_path / "run", report=lines.append)
    _, taught = check_data(plan)
    car = SEMANTICKITTI.classes.index("car")
    assert taught[1, car]
    assert not taught[0, car]
    assert np.argwhere(~not_none(rival_classes(taught))).tolist() == [[0, car]]
    # A line of the check names the dataset that it is about.
    assert all(line.startswith((f"{a.spec}: ", f"{b.spec}: ")) for line in lines)

    # A single stray point teaches nothing.
    path = next((tmp_path / "a/sequences/00").rglob("*.label"))
    raw = np.fromfile(path, np.uint32)
    raw[0] = tiny.CAR
    raw.tofile(path)
    monkeypatch.setattr(checking, "STRAY_SHARE", 0.001)
    assert not check_data(plan)[1][0, car]


def test_streets_are_not_taken_to_lack_the_classes_of_later_epochs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Only the streets of the first epoch are checked."""
    monkeypatch.setattr(simulated, "drive_street", fake_drive)
    monkeypatch.setattr(simulated, "SCANS", 2)
    make_streets(tmp_path / "a", ("00",), 4)
    pole = 80
    for path in (tmp_path / "a").rglob("*.label"):
        raw = np.fromfile(path, np.uint32)
        raw[:5] = pole  # the streets have no pole
        raw.tofile(path)
    a = open_dataset(str(tmp_path / "a"))
    streets = open_dataset(f"simulated-hdl64e:{tmp_path / 'streets'}")
    sources = [Source(a, a.records(["00"])), Source(streets, streets.records(["0", "1"]))]
    recipe = load_recipe("semantickitti-compact")
    _, taught = check_data(Plan(recipe, TrainingData(sources, 0.5), tmp_path / "run"))
    assert taught[1].all()
    assert taught[0, SEMANTICKITTI.classes.index("pole")]


def test_mixed_scans_are_of_the_same_epoch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    epochs = []
    at_epoch = SemanticKitti.at_epoch

    def record_epoch(self: SemanticKitti, record: ScanFile, epoch: int) -> ScanFile:
        epochs.append(epoch)
        return at_epoch(self, record, epoch)

    monkeypatch.setattr(SemanticKitti, "at_epoch", record_epoch)
    augmented = AugmentConfig(mix=1, laser_mix=1, paste=1)
    assert len(ScanSet(mixed(tmp_path, 0.5), Expectation(), augmented)[5, 0])
    assert epochs == [5] * 4  # the scan, and one for each way to mix


def test_datasets_of_other_classes_and_impossible_shares_are_refused(tmp_path: Path) -> None:
    a = open_dataset(str(make_streets(tmp_path / "a")))
    first = Source(a, a.records(["00"]))
    nuscenes = open_dataset(f"nuscenes:{tiny.GOLDEN / 'nuscenes'}")
    assert nuscenes.taxonomy == NUSCENES
    other = Source(nuscenes, nuscenes.records(nuscenes.sequences("all")))
    fails(lambda: TrainingData([first, other]), "classes")
    fails(lambda: TrainingData([first, Source(a, a.records(["08"]))], share=1.0), "share below 1")


@pytest.fixture
def own_file(tmp_path: Path) -> Path:
    """Describe a scan of simulated streets as a user's own."""
    streets = make_streets(tmp_path / "own", ("00",), 2)
    classes = {name: number for number, name in enumerate(SEMANTICKITTI.classes, start=1)}
    description = {"classes": classes, "scans": f"{streets.name}/sequences/00/velodyne/*.bin"}
    return new_file(tmp_path / "own.yaml", yaml.safe_dump(description, sort_keys=False))


def test_streets_mixed_into_ones_own_scans_keep_their_rows(tmp_path: Path, own_file: Path) -> None:
    weights = fresh_weights()
    recipe = sized_by_init(load_recipe("finetune"), weights)
    streets = make_streets(tmp_path / "streets", ("00",), 2)
    lines: list[str] = []
    first, second = (
        open_for_training(str(spec), recipe, tmp_path / "run", weights, report=lines.append)
        for spec in (own_file, streets)
    )
    assumed, advice = lines  # a guess about one's own sensor is no secret
    assert "assumed intensity" in assumed
    assert "under sensor" in advice
    records = first.records(first.sequences("all"))

    data = TrainingData([Source(first, records), to_mix_in(second)])

    view = RangeView(weights.model.range_view)
    assert data.places[1] == 2
    for place, record in enumerate(data.in_epoch(1)):
        batch = PointBatch.of([data.read(len(records) + place)])
        as_is = PointBatch.of([open_dataset(str(streets)).read(record)])
        assert torch.equal(view.rows(batch), view.rows(as_is))


def test_ones_own_scans_are_brought_to_the_initial_weights_rather_than_to_earlier_ones(
    tmp_path: Path, own_file: Path
) -> None:
    by_height = {
        height: replace(fresh_weights(), expects=Expectation(sensor=Sensor(height=height)))
        for height in (1.0, 2.0)
    }
    recipe = sized_by_init(load_recipe("finetune"), by_height[2.0])

    def target(init: Weights | None) -> float | None:
        dataset = open_for_training(str(own_file), recipe, tmp_path / "run", init)
        assert isinstance(dataset, OwnScans)
        assert isinstance(dataset.normalise, Normaliser)
        return not_none(dataset.normalise.expected).sensor.height

    save(by_height[1.0], tmp_path / "run/weights.safetensors")
    assert target(None) == 1.0
    assert target(by_height[2.0]) == 2.0


def test_ones_own_scans_may_come_after_others(tmp_path: Path, own_file: Path) -> None:
    """Scans with rows and scans without are mixed point by point."""
    own = normalised(open_dataset(str(own_file)), Normaliser(fresh_weights().expects))
    sources = [*mixed(tmp_path, 0).sources, Source(own, own.records(own.sequences("all")))]
    data = TrainingData(sources)
    a, b = (data.read(index) for index in (0, len(data) - 1))
    assert a.row is None
    assert b.row is not None

    both = PointBatch.of([mix(a, b, np.random.default_rng(0))])
    view = RangeView(fresh_weights().model.range_view)
    assert both.row is not None
    known = both.row >= 0
    assert 0 < known.sum() < len(known)
    assert torch.equal(view.rows(both)[known], both.row[known])
    assert torch.equal(view.rows(both)[~known], view.rows(replace(both, row=None))[~known])


@pytest.mark.full
def test_weights_of_two_own_datasets_carry_what_scans_were_brought_to(tmp_path: Path) -> None:
    paths = [make_own_scans(tmp_path / name) for name in "ab"]
    weights = fresh_weights(open_own(paths[0]).taxonomy)
    own = [normalised(open_dataset(str(path)), Normaliser(weights.expects)) for path in paths]
    a, b = [Source(each, each.records(each.sequences("train"))) for each in own]

    def expected_of(*sources: Source) -> Expectation:
        return expectation_of(TrainingData(sources), weights, Recipe(), ("rv", "bev"))

    assert not expected_of(a, b).as_is
    assert expected_of(a, b).sensor == expected_of(a).sensor


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make two datasets, the second partly without labels, and weights to begin with."""
    root = tmp_path_factory.mktemp("world")
    make_streets(root / "a", ("00", "08"))
    make_streets(root / "b", ("00", "01"), 3)
    (root / "b/sequences/01/labels/000001.label").unlink()
    save(fresh_weights(), root / "start.safetensors")
    write_recipe(root / "recipe.yaml", "finetune")
    return root


def arguments(world: Path, out: Path, b: str) -> list[object]:
    return [
        *("train", world / "recipe.yaml", "--init", world / "start.safetensors", "--out", out),
        *("--data", world / "a", "--data", b, "--train-sequences", "00", "--val-sequences", "08"),
    ]


def test_the_mean_with_initial_weights_needs_their_classes() -> None:
    recipe = load_recipe("finetune")
    assert recipe.training.rv.initial > 0
    lines: list[str] = []
    for init in (None, fresh_weights()):
        assert without_initial_weights(recipe, init, SEMANTICKITTI, ("rv",), lines.append) is recipe
    assert not lines

    training = without_initial_weights(
        recipe, fresh_weights(NUSCENES), SEMANTICKITTI, ("bev", "head"), lines.append
    ).training
    assert training.rv.initial == training.bev.initial == 0
    assert training.rv.lr == recipe.training.rv.lr
    assert [line.split(":")[0] for line in lines] == ["bev"]


def test_a_training_distils_what_one_of_its_datasets_lacks_and_says_so(
    world: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    relabel_cars(make_streets(tmp_path / "b", ("00",), 3))

    trained = []
    for name, distill in (("with", 5), ("without", 0)):
        command = arguments(world, tmp_path / name, str(tmp_path / "b"))
        options = ("--training.rv.distill", distill, "--training.others", 0.4, "--stage", "rv")
        assert run_cli(*command, *options) == (0, "")
        out = capsys.readouterr().out
        assert "has hardly a point of car" in out
        assert ("keep the initial probabilities" in out) == (distill > 0)
        trained.append(load(tmp_path / name).part("range_net")["scores.bias"])
    assert (trained[0] != trained[1]).any()


@pytest.mark.full
def test_fine_tuning_keeps_the_sizes_and_can_be_repeated(world: Path, tmp_path: Path) -> None:
    # Without the broken sequence, so that all have labels.
    make_streets(tmp_path / "b", ("00",), 3)
    succeed(*arguments(world, tmp_path / "run", str(tmp_path / "b")), "--training.others", "0.4")
    start = load(world / "start.safetensors")
    trained = load(tmp_path / "run")
    assert (trained.model, trained.sensor) == (start.model, start.sensor)
    assert trained.digest("range_net") != start.digest("range_net")

    entry = yaml.safe_load((tmp_path / "run/run.yaml").read_text())["all"]
    assert entry["data"][1].endswith("b@0.4")
    assert entry["init"]["range_net"] == start.digest("range_net")

    # The recipe of the run is a recipe.
    again = arguments(world, tmp_path / "again", str(tmp_path / "b"))
    again[again.index(world / "recipe.yaml")] = tmp_path / "run/recipe.yaml"
    assert run_cli(*again, "--stage", "bev") == (0, "")


def test_a_fine_tuning_needs_weights(world: Path, tmp_path: Path) -> None:
    refused(f"train finetune --data {world / 'a'} --out {tmp_path / 'run'}", "add --init sim-any")


def test_all_sequences_of_another_dataset_are_mixed_in_if_it_has_no_split(tmp_path: Path) -> None:
    data = open_dataset(str(make_streets(tmp_path / "b", ("00", "01", "02"), 2)))
    (data.root / "sequences/01/labels/000001.label").unlink()
    source = to_mix_in(data)
    assert len(source.train) == 5
    assert [record.name for record in source.unlabelled] == ["01/000001"]


def test_scans_to_validate_with_are_not_mixed_in_under_another_name(tmp_path: Path) -> None:
    data = make_streets(tmp_path / "b", ("00", "01"), 2)
    (tmp_path / "c").symlink_to(data)
    first, second = open_dataset(str(data)), open_dataset(str(tmp_path / "c"))
    source = to_train(first, ["00"], ["01"])
    assert len(TrainingData([source, Source(second, second.records(["00"]))])) == 4
    with pytest.raises(InputError, match=r"000000\.bin among both; leave it out of"):
        TrainingData([source, to_mix_in(second)])


def test_scans_of_the_test_split_are_not_mixed_in_either(tmp_path: Path) -> None:
    first = open_dataset(str(make_streets(tmp_path / "b", ("00", "08", "11"), 1)))
    same = Source(first, first.records(["11"]))
    with pytest.raises(InputError, match="apart from those to validate or to test with"):
        TrainingData([to_train(first), same])


def test_scans_of_a_bag_are_told_apart_by_their_names_in_it(tmp_path: Path) -> None:
    data = open_dataset(str(make_streets(tmp_path / "a", ("00", "01"), 1)))
    val, train = (
        [replace(record, path=tmp_path / "d.mcap", name=f"d/{folder}/000000")]
        for folder, record in zip("ab", data.records(["00", "01"]), strict=True)
    )
    source = Source(data, data.records(["00"]), val)
    assert TrainingData([source, Source(data, train)])
    fails(lambda: TrainingData([source, Source(data, val)]), "d.mcap among both")


def test_other_data_without_a_scan_to_train_on_is_refused(tmp_path: Path) -> None:
    data = open_dataset(str(make_streets(tmp_path / "b", ("08",), 1)))
    fails(lambda: to_mix_in(data), "found none outside val and test")


def test_a_training_says_which_scans_of_others_no_epoch_shows(
    world: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = make_streets(tmp_path / "b", ("00", "01"), 5)
    (data / "sequences/01/labels/000001.label").unlink()
    command = arguments(world, tmp_path / "out", str(data))
    options = ("--training.others", 0.2, "--stage", "rv", "--training.rv.epochs", 1)
    assert run_cli(*command, *options) == (0, "")
    out = capsys.readouterr().out
    assert f"{data}: skipped for lack of labels: 1 scan of 01" in out
    assert f"of 9 scans of {data} are used in 1 epoch; --training.others decides" in out


def test_a_recipe_that_takes_the_model_of_init_refuses_another_one(tmp_path: Path) -> None:
    tree = {"base": "finetune", "model": {"assertion": {"threshold": 0.7}}}
    (tmp_path / "mine.yaml").write_text(yaml.safe_dump(tree))
    fails(lambda: load_recipe(str(tmp_path / "mine.yaml")), "no section model")
    # The same value as the paper's is refused too, because --init may have another one.
    option = "--model.assertion.threshold 0.85"
    error = refusal(f"train finetune --data {tmp_path} --out {tmp_path}/run {option}")
    assert "--model.assertion.threshold: expected no option for the model" in error


def test_any_classes_fit_a_recipe_that_takes_the_model_of_init(tmp_path: Path) -> None:
    """They get new last layers."""
    scans = TrainingData([to_train(open_dataset(str(make_streets(tmp_path, ("00", "08"), 1))))])
    init = fresh_weights(NUSCENES)
    Plan(sized_by_init(load_recipe("finetune"), init), scans, tmp_path / "run", init)
    with pytest.raises(InputError, match="use the recipe of that benchmark"):
        Plan(load_recipe("nuscenes-compact"), scans, tmp_path / "run")
