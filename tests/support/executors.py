"""An executor of the tests."""

from collections.abc import Callable
from concurrent.futures import Executor, Future


class SerialExecutor(Executor):
    """Runs each task at once, in this process."""

    def submit(self, task: Callable, /, *arguments, **keywords) -> Future:
        """Run it; the Future holds what came of it."""
        future: Future = Future()
        try:
            future.set_result(task(*arguments, **keywords))
        except Exception as error:
            future.set_exception(error)
        return future
