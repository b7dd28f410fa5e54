"""Mutation testing of the device languages: what the contract and the independent vectors really notice.

    python -m tests.mutation odrive_can             all mutants; goes on where it was interrupted
    python -m tests.mutation odrive_can --sample 300

Rules. The mutants are those of package mutmut (`mutants`). Of a language they change whatever its driver and
its ear lean on in its own folder: derived, not listed. The judge (`judge`) is the conformance kit, clause by
clause and variant by variant, and the language's tests of independent vectors; no other test has a voice. A
mutant is killed by the first that fails, or that raises, or that takes ten times its time (`runner`). What
was found is stored in fixtures/mutation/NAME.json with a hash of each source (`store`); each survivor is
named there, and judged by a person: "equivalent: why" or "missed: what".

mutmut's own runner is not used, for three reasons. It judges by pytest, whose start alone takes longer than
most of our clauses. Its trampolines look into `os.environ` at each call of each function, which the millions
of calls of a rehearsal feel. And they are set into modules that are imported once for all mutants, so that a
mutant of what runs at import (tables of layouts) would never be seen. Here each mutant has a process of its
own, forked from one that has everything imported but the language, which the child then imports with the
mutated module in it.
"""
