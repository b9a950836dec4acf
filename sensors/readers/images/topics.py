"""Which streams of a recording are meant, where a file holds several."""

from dataclasses import dataclass
from pathlib import Path
from typing import Self, final

from rbpf.errors import InputError


@final
@dataclass(frozen=True)
class Topics:
    """Names of streams in a recording that holds several, as a ROS bag does.

    Attributes:
        images: one, or a left and a right one; empty where the recording is to be asked.
        truth: the stream of the camera's true poses; None for none.
    """

    images: tuple[str, ...] = ()
    truth: str | None = None

    @classmethod
    def parse(cls, images: str | None = None, truth: str | None = None) -> Self:
        """The topics of a command line or a run's config.yaml.

        Args:
            images: one name, or two with a comma between them.
            truth: one name.

        Raises:
            InputError: there are more than two, or a name is empty.
        """
        names = () if images is None else tuple(name.strip() for name in images.split(","))
        if len(names) > 2 or not all(names) or truth == "":
            raise InputError(
                f"expected the name of an image topic, or two as LEFT,RIGHT, got {images!r} and truth {truth!r}"
            )
        return cls(names, truth)

    def entries(self) -> dict[str, str]:
        """For a run's config.yaml; what `parse` takes."""
        named = {"image_topic": ",".join(self.images), "truth_topic": self.truth}
        return {name: value for name, value in named.items() if value}

    def require_none(self, path: Path) -> None:
        """Refuse names for a recording that has no topics.

        Raises:
            InputError: one is given.
        """
        if given := self.entries():
            name, value = next(iter(given.items()))
            problem = f"{name.replace('_', ' ')} {value} is given, but only ROS bags have topics"
            raise InputError(f"{path}: {problem}; leave it out.")


UNNAMED = Topics()
