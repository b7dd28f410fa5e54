"""The contract of this plugin, found by its entry point."""

from protocols.conformance import check, table
from protocols.plugin import load


def test_the_contract() -> None:
    """Every clause is kept or does not apply; a failure is shown with the bytes that cause it."""
    results = check(load("robstride_can"))
    print(table(results))
    assert not [result.clause for result in results if result.outcome == "failed"], table(results)
