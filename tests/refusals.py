"""What tests share about errors for bad input."""

import pytest

from ct_envs.errors import UserError


def refusal(call) -> str:
    """The single line with which a call is refused."""
    with pytest.raises(UserError) as refused:
        call()
    message = str(refused.value)
    assert message and message.splitlines() == [message], message
    return message
