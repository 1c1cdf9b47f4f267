"""The console command `jaxsimp`: one module per verb, for a user's own files.

A verb is a module of this package with a dataclass `Options`, whose fields are the options of the
command line and whose method `run()` returns the exit status. `main.VERBS` lists the verbs.
"""
