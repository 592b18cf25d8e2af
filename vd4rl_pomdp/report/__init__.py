"""Reports about runs: statistics, figures, one HTML page."""

from vd4rl_pomdp.report.terminal import print_summary
from vd4rl_pomdp.report.write import write_report

__all__ = ["print_summary", "write_report"]
