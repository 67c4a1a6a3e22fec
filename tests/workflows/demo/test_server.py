"""The server without a browser: uploads that are refused as they begin, and people who leave before their page."""

from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

from viser import _messages as messages

from workflows.demo.server import UPLOADS, DemoServer, stop_large_uploads


def test_one_more_upload_under_way_is_refused() -> None:
    client = MagicMock()
    states: dict[str, Any] = {}
    client.gui._current_file_upload_states = states
    stop_large_uploads(client)
    handlers = dict(call.args for call in client._websock_connection.register_handler.call_args_list)
    for number in range(UPLOADS + 1):
        states[str(number)] = {}  # as viser does before
        about = SimpleNamespace(
            filename="a.obj", size_bytes=9, transfer_uuid=str(number), source_component_uuid="button"
        )
        handlers[messages.FileTransferStartUpload](0, about)
    assert list(states) == [str(number) for number in range(UPLOADS)]
    assert "2 uploads are under way" in client.add_notification.call_args.args[1]


def test_who_left_before_the_page_was_made_takes_no_place() -> None:
    server = DemoServer(MagicMock(), host="127.0.0.1", port=0)
    try:
        gone = MagicMock(client_id=7)
        server._leave(gone)
        server._open(gone)
        assert not server._pages and not list(server.folder.iterdir())
    finally:
        server.close()
