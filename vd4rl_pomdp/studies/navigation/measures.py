"""What is measured of a run on a maze: the name of each number, as a run and a report keep it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

RAW_PREFIX = "raw_"
"""Before an error's name: it is in the simulator's units x 100, which the paper's numbers seem to be."""


class Measure(NamedTuple):
    """Which number of a run this is; its fields are the columns that name a value in results.json and rows.csv."""

    measure: str
    """state_error, position_error or velocity_error (% of a standard deviation), the same after RAW_PREFIX, or
    action_loss (nats x 100)."""
    split: str
    """Trajectories: training or held_out."""
    probe: str
    """What estimated the states: online (trained beside the model) or refit; empty for an action loss."""
    rows: str = "all"
    """Rows that count: all, or hidden for those in which a curtain covers the mass."""
    k: int = 0
    """Pairs (t, t+k) that an action loss is over; 0 is the mean over all k, and stands in every error."""

    @property
    def paper(self) -> str:
        """What the paper has in its tables under this name: state, position, velocity or action_loss; "" for none."""
        if self.k or self.rows != "all":
            return ""
        if self.measure == "action_loss":
            return self.measure
        return self.measure.removeprefix(RAW_PREFIX).removesuffix("_error") if self.is_raw else ""

    @property
    def is_raw(self) -> bool:
        """Whether it is an error in the simulator's units."""
        return self.measure.startswith(RAW_PREFIX)

    def raw(self) -> Measure:
        """The same error in the simulator's units x 100; an action loss is itself."""
        if self.is_raw or self.measure == "action_loss":
            return self
        return self._replace(measure=f"{RAW_PREFIX}{self.measure}")


def refitted_error(component: str, rows: str = "all") -> Measure:
    """Error (%) of a component (state, position or velocity) on held-out trajectories, by the refitted probe."""
    return Measure(f"{component}_error", "held_out", "refit", rows)


def online_error(component: str) -> Measure:
    """Error (%) of a component by the paper's protocol: training averages of the probe beside the model."""
    return Measure(f"{component}_error", "training", "online")


def held_out_loss(k: int = 0) -> Measure:
    """Action loss on held-out trajectories at one k, or over all k."""
    return Measure("action_loss", "held_out", "", k=k)


def measure_of(row: Mapping[str, Any]) -> Measure:
    """The measure that a row of results.json or rows.csv is about; raises KeyError, TypeError or ValueError if none."""
    return Measure(row["measure"], row["split"], row["probe"], row["rows"], int(row["k"]))


def measure_rows(values: Mapping[Measure, float]) -> list[dict[str, Any]]:
    """One row for each value: the measure's fields and `value`."""
    return [measure._asdict() | {"value": value} for measure, value in values.items()]
