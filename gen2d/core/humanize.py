"""Sizes, durations and counts as text."""


def in_bytes(size: float) -> str:
    """Number of bytes as text, such as '7.6 GB'."""
    for unit in ("B", "kB", "MB", "GB", "TB"):
        if size < 1000 or unit == "TB":
            break
        size /= 1000
    return f"{size:.0f} {unit}" if unit == "B" or size >= 100 else f"{size:.1f} {unit}"


def in_time(seconds: float) -> str:
    """Number of seconds as text, such as '2 min 5 s'."""
    if seconds < 59.5:
        return f"{seconds:.0f} s" if seconds >= 10 else f"{seconds:.1f} s"
    minutes, seconds = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes} min" if hours else f"{minutes} min {seconds} s"


def with_noun(number: float, noun: str) -> str:
    """Number of things as text, such as '2 workers'."""
    return f"{number:,g} {noun}{'' if number == 1 else 's'}"
