"""The parser of the command ``varpin``, from which sphinx-argparse writes the page of its options."""

from varpin.cli import command


def parser():
    """The whole parser, commands included."""
    return command._parser()
