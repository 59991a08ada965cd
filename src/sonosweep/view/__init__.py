"""Draws results; computes none."""

from sonosweep.view.content import Report, ReportRun
from sonosweep.view.map_picture import write_map_picture
from sonosweep.view.readme_picture import write_overview_picture
from sonosweep.view.report import report_page, write_report
from sonosweep.view.vessel_picture import write_vessel_picture

__all__ = [
    "Report",
    "ReportRun",
    "report_page",
    "write_map_picture",
    "write_overview_picture",
    "write_report",
    "write_vessel_picture",
]
