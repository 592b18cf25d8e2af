import json

import pytest

from vd4rl_pomdp.studies.navigation.measures import Measure, held_out_loss, measure_of, measure_rows, refitted_error

VALUES = {refitted_error("state"): 3.5, refitted_error("position", rows="hidden"): 4.0, held_out_loss(15): 120.0}


def test_a_measure_and_its_row_are_the_same_thing():
    rows = json.loads(json.dumps(measure_rows(VALUES)))
    assert list(rows[0]) == ["measure", "split", "probe", "rows", "k", "value"], "the order of results.json's keys"
    assert rows[1]["rows"] == "hidden"
    assert {measure_of(row): row["value"] for row in rows} == VALUES
    assert measure_of({"k": "15", **dict.fromkeys(("measure", "split", "probe", "rows"), "")}).k == 15, (
        "from a CSV file"
    )


@pytest.mark.parametrize("name", Measure._fields)
def test_a_row_without_one_of_the_fields_names_it(name):
    (row, *_) = measure_rows(VALUES)
    del row[name]
    with pytest.raises(KeyError, match=name):
        measure_of(row)
