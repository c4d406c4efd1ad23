"""A Slurm of one machine on the loopback, for tests: everything lies in one folder, root is not needed.

``python tests/bench/executors/cluster.py start DIR`` prints the line that makes commands find it; ``stop DIR`` ends it.
Debian has it as ``apt-get install --no-install-recommends slurmctld slurmd slurm-client munge``.
"""

from __future__ import annotations

import getpass
import glob
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

PROGRAMS = ("slurmctld", "slurmd", "munged", "munge", "unmunge", "sbatch", "squeue", "scontrol", "sinfo")
WAIT_S = 90.0
CONFIGURATION = """\
ClusterName=headbench
SlurmctldHost=localhost(127.0.0.1)
SlurmctldPort={ports[0]}
SlurmdPort={ports[1]}
# On the loopback alone.
CommunicationParameters=NoCtldInAddrAny,NoInAddrAny
SlurmUser={user}
SlurmdUser={user}
AuthType=auth/munge
# Credentials that expire soon let a job start again soon.
AuthInfo=socket={folder}/munge/socket,cred_expire=5
CredType=cred/munge
MpiDefault=none
SwitchType=switch/none
# These three need no control groups; memory limits are kept by looking every two seconds.
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
JobAcctGatherType=jobacct_gather/linux
JobAcctGatherFrequency=task=2
JobAcctGatherParams=OverMemoryKill
AccountingStorageType=accounting_storage/none
JobCompType=jobcomp/none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core_Memory
SchedulerType=sched/backfill
SchedulerParameters=sched_interval=1,sched_min_interval=0,bf_interval=1
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
SlurmctldLogFile={folder}/log/slurmctld.log
SlurmdLogFile={folder}/log/slurmd.log
PluginDir={plugins}
PlugStackConfig={folder}/plugstack.conf
MailProg=/bin/true
ReturnToService=2
SlurmdTimeout=60
KillWait=2
MinJobAge=600
InactiveLimit=0
JobRequeue=1
# Jobs of the second partition preempt those of the first.
PreemptType=preempt/partition_prio
PreemptMode=REQUEUE
NodeName=localhost NodeAddr=127.0.0.1 CPUs={cpus} Boards=1 SocketsPerBoard=1 CoresPerSocket={cpus} ThreadsPerCore=1 \
RealMemory={memory} State=UNKNOWN
PartitionName=main Nodes=localhost Default=YES MaxTime=60 DefMemPerCPU=1000 State=UP PriorityTier=1 GraceTime=3 \
PreemptMode=REQUEUE
PartitionName=urgent Nodes=localhost MaxTime=60 DefMemPerCPU=1000 State=UP PriorityTier=2 PreemptMode=OFF
"""


def missing() -> list[str]:
    """Programs of Slurm and munge that are not here."""
    return [name for name in PROGRAMS if shutil.which(name, path=_path()) is None]


def start(folder: Path) -> Path:
    """Start a cluster in an empty folder; return its configuration, which SLURM_CONF is to name."""
    for name in ("munge", "state", "spool", "log"):
        (folder / name).mkdir(parents=True)
    munge = folder / "munge"
    munge.chmod(0o755)
    (munge / "key").write_bytes(os.urandom(128))
    (munge / "key").chmod(0o600)
    options = {
        "key-file": "key",
        "socket": "socket",
        "pid-file": "pid",
        "log-file": "log",
        "seed-file": "seed",
    }
    # Forced: a folder that others may not enter will do, since all is of one user.
    _run(
        "munged",
        "--force",
        "--num-threads=2",
        *(f"--{name}={munge / file}" for name, file in options.items()),
    )
    sent = _run("munge", "-n", f"--socket={munge / 'socket'}")
    _run("unmunge", f"--socket={munge / 'socket'}", text=sent)
    (folder / "plugstack.conf").touch()
    (folder / "cgroup.conf").write_text("CgroupPlugin=cgroup/v1\n")
    plugins = [*glob.glob("/usr/lib/*/slurm*/auth_munge.so"), *glob.glob("/usr/lib*/slurm/auth_munge.so")]
    configuration = folder / "slurm.conf"
    configuration.write_text(
        CONFIGURATION.format(
            folder=folder,
            user=getpass.getuser(),
            ports=_free_ports(),
            cpus=os.cpu_count(),
            memory=os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") * 9 // 10 // 2**20,
            plugins=Path(plugins[0]).parent,
        )
    )
    os.environ["SLURM_CONF"] = str(configuration)
    _run("slurmctld", "-i", "-f", str(configuration))
    _run("slurmd", "-N", "localhost", "-f", str(configuration))
    wait_for(lambda: _answer("sinfo", "-h", "-p", "main", "-o", "%t") == "idle", "the node to be idle")
    return configuration


def stop(folder: Path) -> None:
    """Cancel all jobs and end the cluster's programs."""
    os.environ["SLURM_CONF"] = str(folder / "slurm.conf")
    _answer("scancel", "-u", getpass.getuser())
    try:
        wait_for(lambda: _answer("squeue", "-h") == "", "the jobs to end")
    finally:
        for name in ("slurmd.pid", "slurmctld.pid", "munge/pid"):
            path = folder / name
            if path.exists():
                number = int(path.read_text())
                os.kill(number, signal.SIGTERM)
                wait_for(lambda number=number: not Path(f"/proc/{number}").exists(), f"{name} to end")


def _free_ports() -> list[int]:
    sockets = [socket.socket() for _ in range(2)]
    for each in sockets:
        each.bind(("127.0.0.1", 0))
    ports = [each.getsockname()[1] for each in sockets]
    for each in sockets:
        each.close()
    return ports


def _path() -> str:
    return f"{os.environ['PATH']}:/usr/sbin:/sbin"


def _run(*command: str, text: str = "") -> str:
    environment = {**os.environ, "PATH": _path()}
    done = subprocess.run(
        command, input=text, env=environment, text=True, check=True, stdout=subprocess.PIPE, timeout=WAIT_S
    )
    return done.stdout


def _answer(*command: str) -> str:
    done = subprocess.run(command, check=False, capture_output=True, text=True, timeout=WAIT_S)
    return done.stdout.strip()


def wait_for(condition, what: str = "what is waited for") -> None:
    end = time.monotonic() + WAIT_S
    while not condition():
        if time.monotonic() > end:
            raise TimeoutError(f"waited {WAIT_S:g} s for {what}")
        time.sleep(0.05)


if __name__ == "__main__":
    action, where = sys.argv[1:]
    if action == "start":
        print(f"export SLURM_CONF={start(Path(where).resolve())}")
    else:
        stop(Path(where).resolve())
