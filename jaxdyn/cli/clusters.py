"""Options `--client` and `--workers`: Dask clusters that compute for a command."""

import argparse
import contextlib
from collections.abc import Iterator
from typing import Any

from jaxdyn.cli.common import check_least, whole


def add_cluster_options(parser: Any) -> None:
    """Add the options to a parser or to a group of one."""
    place = parser.add_mutually_exclusive_group()
    place.add_argument(
        "--client", metavar="ADDRESS", help="address of a Dask scheduler whose workers compute, as tcp://host:8786"
    )
    place.add_argument("--workers", type=whole, metavar="N", help="number of local Dask worker processes to start")


@contextlib.contextmanager
def connect(args: argparse.Namespace) -> Iterator[Any]:
    """Connect to the scheduler at --client, or to a local cluster of --workers processes; None with neither.

    **Raises:** ValueError where no scheduler answers, for fewer than one worker, and where Dask is not installed.
    """
    check_least(args, workers=1)
    if args.client is None and args.workers is None:
        yield None
        return
    try:
        # Imported on use: Dask is an extra.
        from distributed import Client, LocalCluster
    except ImportError as error:
        raise ValueError(f"--client and --workers need {error.name}: pip install 'jaxdyn[scale]'") from error
    with contextlib.ExitStack() as stack:
        place = args.client
        if place is None:
            # Any free port for the dashboard, whose address is printed.
            local = LocalCluster(n_workers=args.workers, threads_per_worker=2, processes=True, dashboard_address=":0")
            place = stack.enter_context(local)
        try:
            client = stack.enter_context(Client(place))
        except (OSError, ValueError) as error:
            raise ValueError(f"--client is {args.client}, where no scheduler of Dask answers: {error}") from error
        yield client
