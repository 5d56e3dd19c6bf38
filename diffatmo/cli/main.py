"""The ``diffatmo`` command: its subcommands, and how it ends.

Exit status: 0 for success, 1 for a fit that did not converge (its best point is written all the same) or for images of many
that could not be fitted, 2 for bad input, reported in one line on the standard error, 130 after Ctrl-C or SIGTERM.
"""

import signal
import sys
import threading
from collections.abc import Sequence

import click

from diffatmo import __version__
from diffatmo.cli import cache
from diffatmo.cli.common import INTERRUPTED, is_refusal, one_line
from diffatmo.cli.compare import compare
from diffatmo.cli.export import export
from diffatmo.cli.fit import fit
from diffatmo.cli.imports import import_preset
from diffatmo.cli.plan import plan
from diffatmo.cli.radiance import radiance
from diffatmo.cli.render import render

BAD_INPUT = 2


@click.group(
    invoke_without_command=True, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110}
)
@click.version_option(__version__, message="%(prog)s %(version)s")
@click.pass_context
def diffatmo(context: click.Context) -> None:
    """Which atmosphere made this sky?

    A differentiable sky model, and a fit that recovers an atmosphere's parameters from images, with error bars.
    """
    if context.invoked_subcommand is None:
        click.echo(context.get_help())
    else:
        cache.enable()


diffatmo.add_command(radiance)
diffatmo.add_command(render)
diffatmo.add_command(fit)
diffatmo.add_command(compare)
diffatmo.add_command(export)
diffatmo.add_command(import_preset)
diffatmo.add_command(plan)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line ``arguments`` (those of the process by default) and return its exit status."""
    # Schedulers end a run so: as after Ctrl-C, what was found so far is written.
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        status = diffatmo.main(args=arguments, prog_name="diffatmo", standalone_mode=False)
    except click.Abort:
        return INTERRUPTED
    except (click.ClickException, OSError, ValueError) as error:
        if not is_refusal(error):
            raise
        print("diffatmo: error:", one_line(error), file=sys.stderr)
        return BAD_INPUT
    return status or 0


if __name__ == "__main__":
    sys.exit(main())
