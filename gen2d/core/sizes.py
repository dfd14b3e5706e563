"""Sizes of batches, shards and chunks."""


def power_of_two(limit: int) -> int:
    """Largest power of two that does not exceed the limit; 1 for a smaller limit."""
    return 1 << max(0, limit.bit_length() - 1)


def divisor(number: int, limit: int) -> int:
    """Largest divisor of a number that does not exceed the limit."""
    return next(d for d in range(min(number, limit), 0, -1) if number % d == 0)
