"""The fuzzer of the public doors: `python -m tests.fuzz --minutes N --seed S`.

A *door* is a public function or command that takes a user's values. Each door of `doors/` has a
strategy of its arguments, near and far from what is valid; a predicate of validity, written from
the documentation and not from the code; and checks of what was accepted. Every input is judged:

- right: accepted, and all checks hold; or a valid input within the door's promise
- refused well: a `ValueError`, or an `OSError` for files, that names the value, what is allowed,
  and what to do; or a `TypeError` for a call with wrong names
- refused badly: refused, without one of these
- valid refused: refused, and the predicate says that it is valid
- other exception: any other, a crash of the process among them
- silent: accepted, and the predicate says no, or a check of the result fails
- hang: over `SECONDS`
"""
