"""Which distribution and which RMW: known releases, and what fields and names give away."""

import polars as pl

from chainshaper.sources.system import distribution_of, rmw_of_gids
from chainshaper.values.middleware import rmw_of_threads

OLD = {"rmw_publish": {"message"}}
NEW = {"rmw_publish": {"message", "timestamp"}}
VERSIONS = {
    **{"1.0.5": "foxy", "2.3.0": "galactic", "4.1.1": "humble", "6.3.1": "iron"},
    **{"8.2.2": "jazzy", "8.6.0": "kilted", "8.10.2": "lyrical", "10.0.0": "rolling"},
}


FIELDS: list[tuple[dict[str, set[str]], int, str | None]] = [
    ({}, 0, None),
    (OLD, 24, None),
    ({**OLD, "rclcpp_executor_execute": set()}, 24, "humble"),
    ({**OLD, "rclcpp_intra_publish": set(), "rclcpp_ring_buffer_enqueue": set()}, 24, "iron"),
    (NEW, 0, None),
    (NEW, 24, "jazzy"),
    (NEW, 16, "kilted"),
]


def test_the_distribution_is_known_by_versions_or_fields_or_said_by_caret() -> None:
    for version, distribution in VERSIONS.items():
        tables = {"rcl_init": pl.DataFrame({"version": [version]})}
        assert distribution_of(tables, NEW) == distribution
    for fields, gid_length, known in FIELDS:
        assert distribution_of({}, fields, gid_length) == known
    said = {"caret_init": pl.DataFrame({"distribution": ["iron"]})}
    assert distribution_of({**tables, **said}, {}) == "iron"


def test_rmw() -> None:
    def gids(*first: tuple[int, int]) -> dict[str, pl.DataFrame]:
        return {"rmw_publisher_init": pl.DataFrame({"gid": [[*two, 0, 0] for two in first]})}

    assert rmw_of_gids(gids((1, 15), (1, 15))) == "rmw_fastrtps_cpp"
    assert rmw_of_gids(gids((1, 16))) == "rmw_cyclonedds_cpp"
    assert rmw_of_gids(gids((1, 16), (1, 15))) is None, "a trace of two"
    assert rmw_of_gids(gids((7, 7))) is rmw_of_gids({}) is None
    named = {"rmw_implementation": pl.DataFrame({"rmw_impl": ["rmw_zenoh_cpp"]})}
    assert rmw_of_gids(named) == "rmw_zenoh_cpp"
    for threads, rmw in (
        (["node", "recvUC"], "rmw_cyclonedds_cpp"),
        (["dds.udp.7412"], "rmw_fastrtps_cpp"),
        (["app-0", "net-0", "rx-0"], "rmw_zenoh_cpp"),
        (["rCo00001##Evt"], "rmw_connextdds"),
        (["node"], None),
    ):
        assert rmw_of_threads(threads) == rmw
