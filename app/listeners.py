"""Who wants to hear of changes."""

import threading
from collections.abc import Callable

Listener = Callable[[], None]


class Listeners:
    """May be used from any thread; listeners are called from several."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._listeners: list[Listener] = []

    def add(self, listener: Listener) -> Callable[[], None]:
        """Call `listener` at every notice, until the function returned is called."""
        with self._lock:
            self._listeners.append(listener)

        def forget() -> None:
            with self._lock:
                if listener in self._listeners:
                    self._listeners.remove(listener)

        return forget

    def notify(self) -> None:
        """Call all of them."""
        with self._lock:
            listeners = tuple(self._listeners)
        for listener in listeners:
            listener()
