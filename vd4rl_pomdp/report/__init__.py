"""Reports about runs: statistics, figures, one HTML page."""

from vd4rl_pomdp.report.write import print_summary, write_report

__all__ = ["print_summary", "write_report"]
