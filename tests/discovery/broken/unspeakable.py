"""Raises, where a library should raise an Exception, something else; and it cannot even be printed."""


class Unspeakable(BaseException):
    def __str__(self) -> str:
        raise RuntimeError("no words")


raise Unspeakable
