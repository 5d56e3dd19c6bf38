"""The ``diffatmo`` command: one module per subcommand.

Only the standard library and click are imported at module level, here and in the modules beside this one; JAX and the
models are imported by the subcommand that runs.
"""
