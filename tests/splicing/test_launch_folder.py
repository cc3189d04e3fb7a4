"""The folder of a spliced launch file: whole or absent, replaced or removed only while ours."""

from pathlib import Path
from unittest import mock

import pytest
from launch_cases import NDT, plan_for, robot_file

from chainshaper import ChainPlan, Splicing, splice_launch_files, undo_splice
from chainshaper.planning import Plan
from chainshaper.planning.chain_plan import revised
from chainshaper.splicing import spliced_launch
from chainshaper.values.errors import ChainshaperError, InputError, OperationError
from chainshaper.values.files import rename_output

robot = pytest.fixture(robot_file)


@pytest.fixture
def plan() -> ChainPlan:
    return plan_for("/ndt", "/pose")


@pytest.fixture
def spliced(robot: Path, plan: ChainPlan, tmp_path: Path) -> Splicing:
    return splice_launch_files(Plan.of(plan), [robot], tmp_path / "spliced")


def _tree(folder: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file()
    }


def test_undo_removes_all_of_it_with_what_running_and_building_left(
    spliced: Splicing, robot: Path
) -> None:
    nodes = ("chainshaper_pose", "chainshaper_pose_standby")
    assert {*_tree(spliced.folder)} == {
        *("redirection.py", "robot.launch.py", "shaping_nodes/respawning.py", "splice.json"),
        *(f"shaping_nodes/{name}.{end}" for name in nodes for end in ("py", "yaml")),
    }
    assert spliced.logs == tuple(spliced.folder / "logs" / f"{name}.csv" for name in nodes)
    assert spliced.logs[0].parent.is_dir(), "the node makes no folder for its log"
    assert str(spliced.logs[0]) in spliced.processes[0].parameters_file.read_text()
    for name in ("__pycache__/a.pyc", "logs/chainshaper_pose.csv", "shaping_nodes/build/a/b"):
        path = spliced.folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("left")
    (spliced.folder / "robot.launch.py").unlink()  # what the user removed is not missed
    undo_splice(spliced.folder)
    assert [path.name for path in robot.parent.iterdir()] == [robot.name]
    assert robot.read_text() == NDT
    with pytest.raises(InputError, match="no such folder, so there is nothing to undo"):
        undo_splice(spliced.folder)


@pytest.mark.parametrize(
    "name", ["robot.launch.py", "shaping_nodes/chainshaper_pose.yaml", "mine/logs/a.csv"]
)
def test_what_the_user_changed_or_added_is_neither_removed_nor_replaced(
    spliced: Splicing, robot: Path, plan: ChainPlan, name: str
) -> None:
    path = spliced.folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("mine")
    before = _tree(spliced.folder)
    with pytest.raises(InputError, match=f"{name} was changed or added .* not removed: move away"):
        undo_splice(spliced.folder)
    with pytest.raises(InputError, match=f"{name} was changed or added since .* not overwritten"):
        splice_launch_files(Plan.of(plan), [robot], spliced.folder)
    assert _tree(spliced.folder) == before


@pytest.mark.parametrize("manifest", [None, "", "[]", '{"format": 2}', '{"format": 1}'])
def test_a_folder_that_is_not_ours_is_left_alone(
    tmp_path: Path, robot: Path, plan: ChainPlan, manifest: str | None
) -> None:
    folder = tmp_path / "theirs"
    folder.mkdir()
    (folder / "a").touch()
    if manifest is not None:
        (folder / "splice.json").write_text(manifest)
    with pytest.raises(InputError, match="was not written by `chainshaper splice`, so it is not r"):
        undo_splice(folder)
    with pytest.raises(InputError, match="was not written by `chainshaper splice`, so it is not o"):
        splice_launch_files(Plan.of(plan), [robot], folder)
    assert (folder / "a").exists()


def test_the_same_again_leaves_the_folder_and_another_plan_replaces_it(
    spliced: Splicing, robot: Path, plan: ChainPlan
) -> None:
    spliced.logs[0].write_text("measured")
    inode = spliced.folder.stat().st_ino
    splice_launch_files(Plan.of(plan), [robot], spliced.folder)
    assert spliced.folder.stat().st_ino == inode
    assert spliced.logs[0].read_text() == "measured"
    splice_launch_files(Plan.of(revised(plan, overrun="discard")), [robot], spliced.folder)
    parameters = spliced.processes[0].parameters_file.read_text()
    assert "overrun: discard" in parameters
    assert [path.name for path in robot.parent.iterdir() if path.name.startswith(".")] == []


def test_an_empty_folder_may_be_filled_but_it_needs_a_parent_and_the_original(
    spliced: Splicing, tmp_path: Path, robot: Path, plan: ChainPlan
) -> None:
    (tmp_path / "empty").mkdir()
    assert (
        splice_launch_files(Plan.of(plan), [robot], tmp_path / "empty").folder == tmp_path / "empty"
    )
    assert (tmp_path / "empty/robot.launch.py").is_file()
    with pytest.raises(InputError, match="no such folder to write spliced into"):
        splice_launch_files(Plan.of(plan), [robot], tmp_path / "no" / "spliced")
    robot.unlink()
    with pytest.raises(InputError, match=r"robot\.launch\.xml: cannot be read \(No such file"):
        splice_launch_files(Plan.of(plan), [spliced.folder / "robot.launch.py"], tmp_path / "again")


def test_the_older_folder_comes_back_where_the_new_one_cannot_take_its_place(
    spliced: Splicing, robot: Path, plan: ChainPlan
) -> None:
    before = _tree(spliced.folder)

    def failing(made: Path, path: Path) -> Path:
        if ".partial-" in made.name:
            raise OSError(5, "Input/output error")
        return rename_output(made, path)

    with (
        mock.patch.object(spliced_launch, "rename_output", failing),
        pytest.raises(OperationError, match=r"cannot be written: .*Input/output error"),
    ):
        splice_launch_files(Plan.of(revised(plan, overrun="discard")), [robot], spliced.folder)
    assert _tree(spliced.folder) == before
    assert [path.name for path in robot.parent.iterdir() if path.name.startswith(".")] == []


def test_a_folder_that_cannot_be_written_leaves_nothing(
    full_disk: Path, robot: Path, plan: ChainPlan
) -> None:
    with pytest.raises(ChainshaperError, match="No space left"):
        splice_launch_files(Plan.of(plan), [robot], full_disk / "spliced")
    assert [path.name for path in full_disk.iterdir()] == ["filling"]
