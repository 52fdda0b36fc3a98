"""`python -m jaxdyn` is the command `jaxdyn`."""

from jaxdyn.cli import main

raise SystemExit(main())
