"""Hosts on one machine: each with an address, a name and processes of its own (Linux namespaces), joined by a switch.

The services of docker-compose.yml run on them by their own commands, names and ports. Cables can be pulled, links
slowed, power cut. Nothing changes outside the namespaces, and all of it ends with the processes that hold them.
"""

import re
import secrets
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path

import composefile
import psutil
from composefile import ROOT
from processes import clean_environment

from tests.support.commands import wait_for

_NETWORK = "10.77.0"
_S3 = {
    "AWS_ACCESS_KEY_ID": "k",
    "AWS_SECRET_ACCESS_KEY": "s",
    "AWS_DEFAULT_REGION": "us-east-1",
    "AWS_ENDPOINT_URL": "http://s3:5000",
}
_OBJECT_STORE_BYTES = 80_000_000  # Ray's least is a little less
_WITH_ITS_PARENT = ("setpriv", "--pdeathsig=KILL", "--")
_UNSHARE = ("unshare", "--net", "--uts", "--pid", "--mount", "--fork", "--kill-child", "--mount-proc", "sh", "-ec")
_FIRST_PROCESS = "trap : TERM; while :; do sleep 5; done"  # a shell, which buries orphans too
_SWITCH = f"""
ip link set lo up
ip link add switch type bridge
ip link set switch up
ip address add {_NETWORK}.1/24 dev switch
"""
_PROBE = f"{_SWITCH} ip link add one type veth peer name two"
_TO_ROOT = f"cd {shlex.quote(str(ROOT))}"
_IN_ROOT = f'{_TO_ROOT} && exec "$0" "$@"'
_COMES_BACK = f'{_TO_ROOT} && while :; do "$0" "$@"; sleep 1; done'  # as Compose's `restart: unless-stopped`


def why_not() -> str:
    """Why hosts cannot be made here; empty where they can."""
    missing = [name for name in ("unshare", "nsenter", "setpriv", "ip") if shutil.which(name) is None]
    if missing:
        return f"hosts are made of namespaces: needs Linux with {', '.join(missing)} (util-linux, iproute2)"
    done = subprocess.run([*_UNSHARE, _PROBE], capture_output=True, text=True, check=False)
    words = (done.stderr.strip().splitlines() or [f"exit status {done.returncode}"])[-1]
    return f"namespaces, or what is needed in them, are not allowed here: {words}" if done.returncode else ""


class Namespaces:
    """A first process in namespaces of its own; whatever runs in them ends with it."""

    def __init__(self) -> None:
        self._holder = subprocess.Popen([*_WITH_ITS_PARENT, *_UNSHARE, _FIRST_PROCESS], start_new_session=True)
        wait_for(self._children, 20, what="a namespace")
        self.pid = self._children()[0].pid

    def _children(self) -> list[psutil.Process]:
        return psutil.Process(self._holder.pid).children()

    def entered(self, *command: str) -> list[str]:
        """The command that runs a command in here."""
        return ["nsenter", f"--target={self.pid}", "--net", "--uts", "--pid", "--mount", "--", *command]

    def shell(self, script: str) -> None:
        done = subprocess.run(self.entered("sh", "-ec", script), capture_output=True, text=True, check=False)
        assert done.returncode == 0, f"{script}\n{done.stderr}"

    def end(self) -> None:
        """Power off: SIGKILL to all, and no packet that tells anybody."""
        self._holder.kill()
        self._holder.wait()
        wait_for(lambda: not psutil.pid_exists(self.pid), 20, what="the end of a namespace")


class Host(Namespaces):
    """A machine with one cable to the switch."""

    def __init__(self, name: str, address: str, switch: Namespaces, folder: Path) -> None:
        super().__init__()
        self.name, self.address, self._switch, self._folder = name, address, switch, folder
        # The process's number is known outside; on the switch, a namespace of processes too, it is not.
        subprocess.run(
            f"nsenter --target={switch.pid} --net ip link add {name} type veth peer name eth0 netns {self.pid}".split(),
            check=True,
        )
        switch.shell(f"ip link set {name} master switch up")
        self.shell(
            f"hostname {name}; mount --bind {folder}/names /etc/hosts; mount --bind {folder}/dns /etc/resolv.conf; "
            f"ip link set lo up; ip address add {address}/24 dev eth0; ip link set eth0 up; "
            f"ip route add default via {_NETWORK}.1"
        )

    def end(self) -> None:
        super().end()
        self._switch.shell(f"ip link del {self.name} || :")  # the kernel takes its time, and the name may come again

    @property
    def log(self) -> Path:
        return self._folder / f"{self.name}.log"

    def start(
        self, command: Sequence[str], environment: dict[str, str], *, comes_back: bool = False
    ) -> subprocess.Popen[bytes]:
        """Start a command, its output in :attr:`log`; if it ``comes_back``, again whenever it ends."""
        words = self.entered("sh", "-c", _COMES_BACK if comes_back else _IN_ROOT, *command)
        with self.log.open("ab") as log:
            return subprocess.Popen(words, env=environment, stdin=subprocess.DEVNULL, stdout=log, stderr=log)

    def run(
        self, command: Sequence[str], environment: dict[str, str], *, seconds: float = 60
    ) -> subprocess.CompletedProcess[str]:
        """Run a command to its end; its output is stdout and stderr together."""
        words = self.entered("sh", "-c", _IN_ROOT, *command)
        return subprocess.run(
            words, env=environment, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
            text=True, timeout=seconds, check=False,
        )  # fmt: skip

    @contextmanager
    def unplugged(self) -> Iterator[None]:
        """Without its cable: what is sent is lost in silence, and its own processes go on."""
        self._switch.shell(f"ip link set {self.name} down")
        try:
            yield
        finally:
            self._switch.shell(f"ip link set {self.name} up")

    @contextmanager
    def slowed(self, *, seconds: float, bits_a_second: float) -> Iterator[None]:
        """With a cable on which each frame takes so long, and no more than so much passes in each direction."""
        ends = "slow-in", "slow-out"
        self._switch.shell(
            f"ip link add {ends[0]} type veth peer name {ends[1]}; ip link set {self.name} nomaster; "
            f"ip link set {ends[0]} up; ip link set {ends[1]} master switch up"
        )
        script = str(Path(__file__).with_name("slow_cable.py"))
        words = [sys.executable, script, self.name, ends[0], str(seconds), str(bits_a_second)]
        cable = subprocess.Popen(self._switch.entered(*_WITH_ITS_PARENT, *words))
        try:
            yield
        finally:
            cable.kill()
            cable.wait()
            self._switch.shell(f"ip link del {ends[0]}; ip link set {self.name} master switch")


class Lab:
    """A switch, hosts on it, a folder that all of them see, and the secret of this run."""

    def __init__(self) -> None:
        # Ray's socket paths have a limit of 107 characters, which pytest's folders pass.
        self.folder = Path(tempfile.mkdtemp(prefix="dsf", dir="/tmp"))
        self._names = self.folder / "names"
        self._names.write_text("127.0.0.1 localhost\n")
        (self.folder / "dns").write_text("nameserver 127.0.0.1\n")  # says no at once, as to questions for IPv6
        self._token, self._number = secrets.token_hex(32), 1
        self.hosts: dict[str, Host] = {}
        self._switch = Namespaces()
        self._switch.shell(_SWITCH)

    def add(self, name: str, *, address: str = "") -> Host:
        """A new host, at the next address unless one is given."""
        self._number += 1
        address = address or f"{_NETWORK}.{self._number}"
        kept = [line for line in self._names.read_text().splitlines() if line.split()[1] != name]
        self._names.write_text("\n".join([*kept, f"{address} {name}", ""]))  # in place: it is mounted everywhere
        self.hosts[name] = Host(name, address, self._switch, self.folder)
        return self.hosts[name]

    def end(self) -> None:
        """End all of it, and remove the folder, also where one of them resists."""
        with ExitStack() as ends:
            ends.callback(shutil.rmtree, self.folder, ignore_errors=True)
            for each in (self._switch, *self.hosts.values()):
                ends.callback(each.end)

    def environment(self, service: str = "client") -> dict[str, str]:
        """The service's environment in the Compose file, and where its secrets would be."""
        given: dict[str, str] = composefile.services()[service].get("environment", {})
        return clean_environment() | {"RAY_AUTH_TOKEN": self._token, "OMP_NUM_THREADS": "1"} | _S3 | given

    def command(self, service: str) -> list[str]:
        """The service's own command, with this machine's paths."""
        variables = {"RAY_OBJECT_STORE_BYTES": str(_OBJECT_STORE_BYTES), "RAY_WORKER_CPUS": "1"}
        words: list[str] = composefile.services(**variables)[service]["command"]
        return [self._here(word) for word in words]

    def _here(self, word: str) -> str:
        word = re.sub(r"^(--backend-store-uri=).*", rf"\1sqlite:///{self.folder}/mlflow.db", word)
        word = re.sub(r"(^|=)/(data|artifacts)\b", rf"\1{self.folder}/\2", word)
        return re.sub(r"^/app\b", str(ROOT), word)

    def serve(self, service: str, host: Host) -> None:
        """Start a service of the Compose file on a host, which starts it again whenever it ends."""
        command = self.command(service)
        if service.startswith("ray-"):
            command.append(f"--temp-dir={self.folder}/{host.address.rpartition('.')[2]}")  # /tmp is this machine's
        host.start(command, self.environment(service), comes_back=True)

    def is_well(self, service: str, host: Host) -> bool:
        """What the service's own health check says."""
        check: list[str] = composefile.services()[service]["healthcheck"]["test"][1:]
        return host.run([self._here(word) for word in check], clean_environment()).returncode == 0
