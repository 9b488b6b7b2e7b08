"""Names of emulated devices on this computer: folders made for them, and no name taken from another program."""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from monstertruck_drivers.cable import reserved
from monstertruck_runtime.endpoints import make_private, runtime_folder
from monstertruck_runtime.errors import NotPermittedError


@contextmanager
def claimed(*links: Path) -> Iterator[None]:
    """Keep the names of links for this program while the context lasts; their folders are made.

    The folder of this user's own, where ports hang that no configuration names, lets nobody else in.

    Raises:
        NotPermittedError: this user may not make a link there, or others may in the folder of this user's own.
        BusyError: another program serves one of them.
        InputError: something else than a link has the name.
        OSError: a link cannot be made there.
    """
    with ExitStack() as stack:
        try:
            if any(runtime_folder() in link.parents for link in links):
                make_private(runtime_folder())
            for link in links:
                link.parent.mkdir(parents=True, exist_ok=True)
            stack.enter_context(reserved(*links))
        except PermissionError as error:
            raise NotPermittedError(f"{error.filename}: this user may not make a port there") from error
        except OSError as error:
            if error.errno is None:
                raise NotPermittedError(str(error)) from None
            raise
        yield
