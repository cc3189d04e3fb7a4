"""Which topics a process publishes asynchronously, as rmw_fastrtps was asked to.

Upstream: rmw_fastrtps_cpp, `create_publisher`; Fast DDS, `XMLProfileManager::loadDefaultXMLFile`.
"""

from collections.abc import Callable, Iterator
from pathlib import Path
from xml.etree import ElementTree

from chainshaper.sources.ros import environment_of
from chainshaper.values.errors import OperationError

_KNOWN = {"ASYNCHRONOUS": True, "SYNCHRONOUS": False}


def publication_modes(pid: int) -> Callable[[str], bool | None]:
    """What says of a topic whether a process publishes it asynchronously; None: not known.

    Files of profiles count where rmw_fastrtps leaves it to them: the topic's own profile, else the
    default one, else it is synchronous. Where no file is, a program may bring profiles itself.
    """
    try:
        asked = environment_of(pid).variables
    except OperationError:
        return lambda _: None
    default = "SYNCHRONOUS" if "fastrtps" in asked.get("RMW_IMPLEMENTATION", "") else ""
    mode = asked.get("RMW_FASTRTPS_PUBLICATION_MODE") or default
    if mode != "AUTO" and asked.get("RMW_FASTRTPS_USE_QOS_FROM_XML") != "1":
        return lambda _: _KNOWN.get(mode)
    files = [asked.get(f"{one}_DEFAULT_PROFILES_FILE") for one in ("FASTRTPS", "FASTDDS")]
    files += [f"DEFAULT_{one}_PROFILES.xml" for one in ("FASTRTPS", "FASTDDS")]
    profiles: dict[str, bool] = {}
    otherwise = None
    for file in (Path(f"/proc/{pid}/cwd", name) for name in files if name):
        try:
            if file.is_file():
                profiles = dict(_profiles(file)) | profiles  # the first of a name counts
                otherwise = False
        except (OSError, ElementTree.ParseError):
            continue
    return lambda topic: profiles.get(topic, profiles.get("", otherwise))


def _profiles(file: Path) -> Iterator[tuple[str, bool]]:
    """The profiles of writers in a file, the default one as that of a topic without a name."""
    root = ElementTree.parse(file).getroot()  # noqa: S314 - expat bounds what entities expand to
    for profile in root.iter():
        if profile.tag.rpartition("}")[2] in ("data_writer", "publisher"):
            mode = profile.findtext(".//{*}publishMode/{*}kind", "").strip()
            yield profile.get("profile_name", ""), mode == "ASYNCHRONOUS"
            if profile.get("is_default_profile") == "true":
                yield "", mode == "ASYNCHRONOUS"
