"""Which distribution and which RMW: known releases, and what fields and names give away."""

import polars as pl
import pytest

from chainshaper.sources.system import distribution_of, rmw_of_gids, rmw_of_threads

OLD_PUBLISH = {"rmw_publish": {"message"}}
NEW_PUBLISH = {"rmw_publish": {"message", "timestamp"}}


@pytest.mark.parametrize(
    ("version", "distribution"),
    [
        ("1.0.5", "foxy"),
        ("2.3.0", "galactic"),
        ("4.1.1", "humble"),
        ("6.3.1", "iron"),
        ("8.2.2", "jazzy"),
        ("8.6.0", "kilted"),
        ("8.10.2", "lyrical"),
        ("10.0.0", "rolling"),
    ],
)
def test_versions_of_tracetools(version: str, distribution: str) -> None:
    tables = {"rcl_init": pl.DataFrame({"version": [version]})}
    assert distribution_of(tables, NEW_PUBLISH) == distribution


@pytest.mark.parametrize(
    ("fields", "gid_length", "distribution"),
    [
        ({}, 0, None),
        (OLD_PUBLISH, 24, None),
        ({**OLD_PUBLISH, "rclcpp_executor_execute": {}}, 24, "humble"),
        ({**OLD_PUBLISH, "rclcpp_intra_publish": {}, "rclcpp_ring_buffer_enqueue": {}}, 24, "iron"),
        (NEW_PUBLISH, 0, None),
        (NEW_PUBLISH, 24, "jazzy"),
        (NEW_PUBLISH, 16, "kilted"),
    ],
)
def test_fields_without_a_version(
    fields: dict[str, set[str]], gid_length: int, distribution: str | None
) -> None:
    assert distribution_of({}, fields, gid_length) == distribution


def test_caret_says_the_distribution_itself() -> None:
    tables = {
        "caret_init": pl.DataFrame({"distribution": ["iron"]}),
        "rcl_init": pl.DataFrame({"version": ["4.1.1"]}),
    }
    assert distribution_of(tables, {}) == "iron"


def test_rmw() -> None:
    def gids(*first: tuple[int, int]) -> dict[str, pl.DataFrame]:
        return {"rmw_publisher_init": pl.DataFrame({"gid": [[*two, 0, 0] for two in first]})}

    assert rmw_of_gids(gids((1, 15), (1, 15))) == "rmw_fastrtps_cpp"
    assert rmw_of_gids(gids((1, 16))) == "rmw_cyclonedds_cpp"
    assert rmw_of_gids(gids((1, 16), (1, 15))) is None, "a trace of two"
    assert rmw_of_gids(gids((7, 7))) is None
    assert rmw_of_gids({}) is None
    named = {"rmw_implementation": pl.DataFrame({"rmw_impl": ["rmw_zenoh_cpp"]})}
    assert rmw_of_gids(named) == "rmw_zenoh_cpp"
    assert rmw_of_threads(["node", "recvUC"]) == "rmw_cyclonedds_cpp"
    assert rmw_of_threads(["dds.udp.7412"]) == "rmw_fastrtps_cpp"
    assert rmw_of_threads(["app-0", "net-0", "rx-0"]) == "rmw_zenoh_cpp"
    assert rmw_of_threads(["rCo00001##Evt"]) == "rmw_connextdds"
    assert rmw_of_threads(["node"]) is None
