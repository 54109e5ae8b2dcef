"""How far the clock of a sender is from this machine's, so that the age of its messages can be told."""

from typing import Literal

LEARN_COUNT, LEARN_SECONDS = 10, 0.5  # messages, [s] that agree before another clock is trusted; choice
DRIFT = 1e-3  # [1] by which two clocks may run apart; quartz keeps to 1e-4


class ClockOffset:
    """The offset of one session, from stamps alone.

    Receiving minus sending is offset plus delay, and no delay is negative: the smallest difference seen so
    far is the best estimate of the offset, and what a message exceeds it by is its age. So a clock may count
    from anywhere, as ticks of a board do, but a delay that all messages share cannot be told.
    Source: Mills et al. 2010, RFC 5905, section 10 (the clock filter takes the sample of least delay).

    A stamp that agrees with this machine's clock tells the offset at once. Otherwise LEARN_COUNT of them over
    LEARN_SECONDS must agree: messages that waited for their reader come all at once, so their differences
    fall. Once the offset is known, a stamp that is ahead is refused unless the one before it was alike: one
    wrong stamp moves nothing, and a clock that has been set ahead costs one message.
    """

    def __init__(self, max_age: float, max_lead: float) -> None:
        """Args: see `StreamConfig`."""
        self._max_age, self._max_lead = max_age, max_lead  # [s]
        self._offset: float | None = None  # [s] unknown until a stamp has been taken
        self._received = 0.0  # [s] when it was last confirmed
        self._refused: float | None = None  # [s] difference of the stamp refused last
        self._first, self._since, self._count = 0.0, 0.0, 0  # [s] difference, [s] when, of those that agree

    def judge(self, sent: float, received: float) -> Literal["late", "early", "clock_unknown"] | None:
        """Take in the stamps [s] of a message, each of its own clock.

        Returns: what makes it unfit, or None.
        """
        difference = received - sent
        if self._offset is None:
            agrees = -self._max_lead <= difference <= self._max_age
            if not agrees and not self._learnt(difference, received):
                return "clock_unknown"
            known = difference
        else:
            alike = self._refused is not None and abs(difference - self._refused) <= self._max_lead
            known = self._offset + DRIFT * max(received - self._received, 0.0)
            late = difference > known + self._max_age
            # a stamp that is not ahead of this machine's clock is never too early
            early = difference < min(known, 0.0) - self._max_lead
            # messages that a network held up are late alike as well: they stay refused
            if late or (early and not alike):
                self._refused = difference
                return "late" if late else "early"
        self._offset = min(known, difference)
        self._received, self._refused = received, None
        return None

    def _learnt(self, difference: float, received: float) -> bool:
        """Whether enough stamps agree with this one for its difference [s] to be an offset."""
        if self._count == 0 or abs(difference - self._first) > self._max_lead:
            self._first, self._since, self._count = difference, received, 0
        self._count += 1
        return self._count >= LEARN_COUNT and received - self._since >= LEARN_SECONDS
