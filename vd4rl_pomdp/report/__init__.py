"""Reports about runs: statistics, tables, figures, one HTML page.

What other rooms use, and may rely on:

    load.load_runs, Run         one typed record a run; `runs_frame` and `episodes_frame` make pandas frames of them
    tables                      group-bys of the frames: evaluations, summary, aggregate, improvement, ...
    gates, claims               what has to hold before methods are ranked, and the paper's claims with verdicts
    stats                       means, differences, intervals; `number`, `with_interval`, `mean_and_error` in words
    load.Choice, without_options    what a report is about, such as a grid's cells
    page.write_report           a report's folder: `shown` has its tables, `figures` its figures
"""

from vd4rl_pomdp.report.page import print_summary, write_report

__all__ = ["print_summary", "write_report"]
