"""``python -m hiros_cli``, for an environment whose scripts are not on the path."""

from hiros_cli.app import main

main()
