"""The version, maintainer and licence that files of packages name; `pyproject.toml` has them.

ament's linters look for a notice in each source file, and for the file LICENSE in each package.
"""

import re
from collections.abc import Mapping
from email.utils import parseaddr
from functools import cache
from importlib.metadata import distribution
from pathlib import PurePath

__all__ = ["package_values", "with_licence"]

_NOTICE = """Copyright 2026 {owner}

Licensed under the Apache License, Version 2.0 (the "License");
you may not use this file except in compliance with the License.
You may obtain a copy of the License at

    http://www.apache.org/licenses/LICENSE-2.0

Unless required by applicable law or agreed to in writing, software
distributed under the License is distributed on an "AS IS" BASIS,
WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
See the License for the specific language governing permissions and
limitations under the License."""
_STATEMENT = re.compile(r"\A(//|#) Copyright 2026 .*\n")  # at the top of our sources
_COMMENTS = {".cpp": "//", ".hpp": "//", ".py": "#"}


@cache
def package_values() -> Mapping[str, str]:
    """Return what takes the places ``@VERSION@``, ``@MAINTAINER@`` and ``@EMAIL@`` in a package."""
    name, email = parseaddr(distribution("chainshaper").metadata["Maintainer-Email"])
    return {"VERSION": distribution("chainshaper").version, "MAINTAINER": name, "EMAIL": email}


def with_licence(files: Mapping[str, str]) -> dict[str, str]:
    """Return a package's files, by their paths, with a notice in each, and with the licence."""
    notice = _NOTICE.format(owner=package_values()["MAINTAINER"]).splitlines()
    licensed = {}
    for path, text in files.items():
        sign = _COMMENTS.get(PurePath(path).suffix)
        lines = [] if sign is None else [f"{sign} {line}".rstrip() for line in notice] + [""]
        licensed[path] = "\n".join([*lines, _STATEMENT.sub("", text) if lines else text])
    licence = distribution("chainshaper").read_text("licenses/LICENSE")
    return licensed | {"LICENSE": licence or "Apache-2.0\n"}
