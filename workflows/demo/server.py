"""The server of the page: one session a person, uploads that are stopped at their limit, nothing left behind."""

import contextlib
import io
import tempfile
import threading
from pathlib import Path

import viser
from viser import _messages as messages

from datagen.common.errors import MeshError
from workflows.demo.page import Page
from workflows.demo.transfers import Transfers
from workflows.demo.uploads import require_size

PEOPLE = 8
"""At the page at once."""
UPLOADS = 2
"""Of one person under way at once: of source and of target."""


class DemoServer:
    """Pages for whoever opens them, until it is closed."""

    def __init__(self, transfers: Transfers, *, host: str, port: int) -> None:
        self._transfers = transfers
        self._folder = tempfile.TemporaryDirectory(prefix="dsffnet-demo-")
        self._pages: dict[int, Page] = {}
        self._lock = threading.Lock()
        with contextlib.redirect_stdout(io.StringIO()):  # its own words say less than the command's
            self._server = viser.ViserServer(host=host, port=port, label="dsffnet", verbose=False)
        self._server._websock_server.unregister_handler(messages.ShareUrlRequest)  # it would open a way in from outside
        self._server.on_client_connect(self._open)
        self._server.on_client_disconnect(self._leave)

    @property
    def port(self) -> int:
        """Where it listens."""
        return self._server.get_port()

    @property
    def folder(self) -> Path:
        """Under which each session has a folder of its own."""
        return Path(self._folder.name)

    def close(self) -> None:
        """End every session."""
        with contextlib.redirect_stdout(io.StringIO()):
            self._server.stop()
        with self._lock:
            pages = [self._pages.pop(client) for client in list(self._pages)]
        for page in pages:
            page.close()
        self._folder.cleanup()

    def _open(self, client: viser.ClientHandle) -> None:
        with self._lock:
            if client.client_id not in self._server.get_clients():
                return  # left before it got its turn: nobody would take its page away
            if len(self._pages) >= PEOPLE:
                client.add_notification("Full", f"{PEOPLE} people are at this page: come back later", color="red")
                return
            stop_large_uploads(client)
            self._pages[client.client_id] = Page(client, self.folder / str(client.client_id), self._transfers)

    def _leave(self, client: viser.ClientHandle) -> None:
        with self._lock:
            page = self._pages.pop(client.client_id, None)
        if page is not None:
            page.close()


def stop_large_uploads(client: viser.ClientHandle) -> None:
    """Refuse an upload when it is announced, and one that turns out longer: viser would first take all into memory.

    It has no public way to; what is used of its inside is of the version that constraints.txt names.
    """
    gui, connection = client.gui, client._websock_connection

    def begins(_: int, message: messages.FileTransferStartUpload) -> None:
        try:
            require_size(message.filename, message.size_bytes)
            if len(gui._current_file_upload_states) > UPLOADS:  # viser has counted this one already
                raise MeshError(f"{UPLOADS} uploads are under way: wait for them, or load the page again")
        except MeshError as error:
            gui._current_file_upload_states.pop(message.transfer_uuid, None)
            size = message.size_bytes  # taken for received, the browser's button is free again
            connection.queue_message(
                messages.FileTransferPartAck(message.source_component_uuid, message.transfer_uuid, size, size)
            )
            connection.queue_message(messages.RemoveNotificationMessage(f"upload-{message.transfer_uuid}"))
            client.add_notification("That cannot be posed", str(error), color="red", auto_close_seconds=20)

    def goes_on(_: int, message: messages.FileTransferPart) -> None:
        state = gui._current_file_upload_states.get(message.transfer_uuid)
        if state and state["transferred_bytes"] > state["total_bytes"]:
            gui._current_file_upload_states.pop(message.transfer_uuid)

    connection.register_handler(messages.FileTransferStartUpload, begins)
    connection.register_handler(messages.FileTransferPart, goes_on)
