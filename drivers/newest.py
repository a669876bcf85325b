"""A queue of one picture: the newest wins, so that a slow consumer sees the present."""

from __future__ import annotations

import threading

from drivers.capture import RawPicture


class NewestPicture:
    """Handed from the thread that captures to the one that consumes; holds one picture at most."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._picture: RawPicture | None = None
        self._ended = False
        self.overtaken = 0
        """Pictures that nobody took: a newer one, or the end, came first."""

    def put(self, picture: RawPicture) -> None:
        """Offer ``picture``; one that still waits is released and counted."""
        with self._changed:
            unwanted = picture if self._ended else self._picture
            self._picture = None if self._ended else picture
            self._changed.notify_all()
        self._overtake(unwanted)

    def take(self) -> RawPicture | None:
        """The newest picture, waited for; None once the queue has ended."""
        with self._changed:
            self._changed.wait_for(lambda: self._picture is not None or self._ended)
            picture, self._picture = self._picture, None
            return picture

    def end(self) -> None:
        """Wake whoever waits; a picture that still waits is dropped, and no more are accepted."""
        with self._changed:
            unwanted, self._picture = self._picture, None
            self._ended = True
            self._changed.notify_all()
        self._overtake(unwanted)

    def _overtake(self, picture: RawPicture | None) -> None:
        if picture is not None:
            self.overtaken += 1
            picture.release()
