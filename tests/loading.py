"""Robot files as tests load them."""

import warnings

import jaxdyn as jd


def silent(path, **options) -> jd.io.LoadedScene:
    """The scene of a file, whatever is not taken or looks wrong."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # the compiler's own too, of attributes that are to go
        return jd.load(path, **options)
