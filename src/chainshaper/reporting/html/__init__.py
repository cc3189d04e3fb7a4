"""The report: one HTML page with everything in it that a timing engineer sends to a colleague.

Tables are written here, charts are drawn in the page by scripts of its own from the data that it
carries. It loads nothing: it works from a disk, in an archive, and without a network.
"""

from chainshaper.reporting.html.page import write_report

__all__ = ["write_report"]
