"""``python -m hiros_mcap``: the command line, where its script is not on the path."""

import runpy

if __name__ == "__main__":
    runpy.run_module("hiros_cli", run_name="__main__")
