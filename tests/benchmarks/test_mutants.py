"""The faults of benchmarks/mutants.toml still fit the code that they are put into."""

import mutants


def test_every_fault_fits_its_file():
    for file, what, code, fault in mutants.faults():
        assert mutants.faulty(file, code, fault) != (mutants.ROOT / file).read_text(), what
    assert {file for file, *_ in mutants.faults()} == set(mutants.TESTS)
