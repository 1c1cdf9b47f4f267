"""The console command `jaxsimp`: one module a verb, for a user's own files."""
