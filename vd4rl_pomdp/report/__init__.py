"""Reports about runs: statistics, tables, figures, one HTML page.

Interface for the rest of the package:

    load.load_runs, Run         one typed record per run; `runs_frame` and `episodes_frame` turn them into pandas frames
    tables                      group-bys of the frames: evaluations, summary, aggregate, improvement, ...
    gates                       conditions for ranking methods, and the paper's claims with verdicts
    stats                       means, differences, intervals; `number`, `with_interval`, `mean_and_error` format them
    load.Choice                 what a report covers, such as a grid's cells
    page.write_report           writes a report's folder; `figures` makes its figures
"""
