"""The command line: `main` and one module per command, each with `add_arguments(parser)` and `run(options)`.

Exports nothing: `gateway.cli.main` is imported by `gateway.__main__` alone, and a command's module by
`gateway.cli.main` when that command is given. It may import every room; no room may import it, and it
must not import what is heavy before a command needs it.
"""
