"""`python -m fab4d` is the same as `fab4d`."""

from fab4d.cli import main

main()
