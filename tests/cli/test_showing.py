"""What a command's result looks like on the terminal."""

from rbpf.cli.showing import table


def test_names_and_values_stand_one_a_line():
    shown = table({"frames": 3, "error_m": 0.123456789, "ms": {"median": 1.5, "p95": 2.0}}, width=8)
    assert shown.splitlines() == ["  frames  3", " error_m  0.123457", "      ms  median 1.5, p95 2"]


def test_of_a_long_list_the_beginning_is_shown_one_item_a_line():
    shown = table({"problems": [f"frame {k}" for k in range(7)]}, width=8).splitlines()
    assert shown[:2] == ["problems  frame 0", "          frame 1"]
    assert shown[-1] == "          … and 3 more, in summary.json" and len(shown) == 5
