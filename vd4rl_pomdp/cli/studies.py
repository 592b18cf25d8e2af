"""Commands of the other studies: theory, bench, certify."""

from __future__ import annotations

import json as json_library
import sys
from pathlib import Path

import tyro

from vd4rl_pomdp.cli.parsing import command, show
from vd4rl_pomdp.cli.sweeps import carry_out
from vd4rl_pomdp.core.errors import refuse_no_folder
from vd4rl_pomdp.runs.outputs import refuse_foreign, refuse_kept
from vd4rl_pomdp.sweeps.options import LocalOptions, own_program, refuse_unknown_to_jobs


@command
def theory(json: bool = False, out: Path | None = None) -> None:
    """Compute the paper's claims on finite worlds by enumeration, and list where its text differs.

    Args:
        json: Print one JSON object.
        out: Also write the JSON and an HTML page with figures into this folder.
    """
    from vd4rl_pomdp.report import theory as theory_page
    from vd4rl_pomdp.studies.theory.study import theory_study

    if out is not None:
        refuse_foreign(out, "study of the theory", theory_page.FILE)
        out.mkdir(parents=True, exist_ok=True)  # fail before the computation
    study = theory_study()
    if json:
        print(json_library.dumps(study))
    else:
        theory_page.print_theory(study)
    if out is not None:
        print(f"page: {theory_page.write_theory(study, out)}", file=sys.stderr if json else sys.stdout)


@command
def bench(json: bool = False, quick: bool = False, gpu: bool = False, device: str = "auto") -> None:
    """Measure speed and memory of every stage on this machine, as ratios within one run.

    Args:
        json: Print one JSON object instead of a table.
        quick: A tenth of the frames and fewer repetitions: rougher numbers, not compared with the goals.
            With --gpu only a test of the code.
        gpu: Benchmark the paper preset on one GPU instead: CUDA graphs, stacked seeds, JAX, encoding, evaluation.
            It takes under three minutes.
        device: Training device: auto, cpu or cuda. With --gpu and --quick, cpu tests the code without a GPU.
    """
    from vd4rl_pomdp.bench import gpu as on_gpu
    from vd4rl_pomdp.bench import suite

    results = on_gpu.gpu_bench(device, quick) if gpu else suite.bench(quick, device)
    if json:
        show(results, as_json=True)
    elif gpu:
        claims = on_gpu.AIMS if results["device"] == "cuda" and not quick else {}
        suite.print_table(
            results, claims, "one GPU, medians of one run" if claims else "a trial of the code: no claims"
        )
    else:
        suite.print_table(results, {} if quick else suite.GOALS, "speed and memory, ratios within one run")


@command
def certify(
    data: tyro.conf.Positional[Path],
    corruption: tyro.conf.Positional[str],
    out: Path,
    returns: bool = False,
    change: tuple[str, ...] = (),
    jobs: int = 0,
) -> None:
    """Decide with supervised encoders whether a dataset needs a memory of past observations. Re-run to resume.

    Args:
        data: Folder of a dataset with simulator states; the certificate is written there.
        corruption: The corruption that makes observations partial.
        out: Folder of the runs.
        returns: Also train and evaluate policies, in addition to linear probes.
        change: Training settings: seed=0,1,2,3,4 preset=cpu pretrain.patch_size=24 finetune.updates=60000.
        jobs: Concurrent jobs; 0: as many as the GPUs take, or one without a GPU.
    """
    from vd4rl_pomdp.runs.results import CERTIFICATES, certificate_in_words
    from vd4rl_pomdp.studies import certify as certificates
    from vd4rl_pomdp.sweeps.folder import SweepFolder

    refuse_no_folder(out)
    refuse_kept(out)
    options = LocalOptions(jobs=jobs)
    options.check()
    dataset, cells, trainings = certificates.planned(data, corruption, out, returns, change)
    for training in trainings:
        refuse_unknown_to_jobs(training.settings)
    folder = SweepFolder(out)
    carry_out([folder.keep_plan(certificates.GRID, trainings, own_program())], folder, "local", options)
    print(f"{corruption}: {certificate_in_words(certificates.certify(dataset, cells, out, returns))}")
    print(f"certificate: {out / CERTIFICATES}")
