"""`tdhil serve`: rigs, runs and live pages in a browser, with users and roles."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from profiles import MessageCode, visible

DATA = Path("tdhil-data")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of serve."""
    from tdhil.service import HOST, MEBIBYTE, PORT, UPLOAD_LIMIT

    parser.add_argument("--rigs", type=Path, metavar="DIR",
                        help="folder with a rig.yaml for each rig (default: two simulated rigs)")
    parser.add_argument("--data", type=Path, metavar="DIR", default=DATA,
                        help=f"folder of runs, accounts, audit and index (default: {DATA})")
    parser.add_argument("--logs", type=Path, metavar="DIR", action="append", default=[],
                        help="folder of logs that the page Fleet may identify again, besides the service's own "
                             "runs; repeatable")
    parser.add_argument("--upload-limit", type=int, metavar="MIB", default=UPLOAD_LIMIT // MEBIBYTE,
                        help="largest recording that may be uploaded, MiB (default %(default)s)")
    parser.add_argument("--host", default=HOST, metavar="ADDRESS",
                        help=f"address to listen on (default {HOST}: this computer only; others need users and TLS)")
    parser.add_argument("--port", type=int, default=PORT, metavar="N", help=f"TCP port (default {PORT}; 0: any "
                                                                            f"free port)")
    parser.add_argument("--viewer", action="append", metavar="ORIGIN", default=[],
                        help="origin of Foxglove or Lichtblick in a browser, such as http://localhost:8080:"
                        " that page may read logs as they grow, and nothing else; repeatable")
    parser.add_argument("--mqtt", metavar="URL",
                        help="publish the rigs' states and results to a broker, mqtt[s]://host:port/prefix; user "
                             "and password"
                        " from TDHIL_MQTT_USER and TDHIL_MQTT_PASSWORD_FILE (extra mqtt)")
    parser.add_argument("--webhook", metavar="URL",
                        help="send a JSON message to this address when a run has ended or failed, and when a rig's"
                        " results have changed; signed with the secret in TDHIL_WEBHOOK_SECRET_FILE")
    parser.add_argument("--mail", metavar="URL",
                        help="send an e-mail for the same events, smtp[s]://user@host:port/recipient,recipient; the"
                        " password is in the file that TDHIL_MAIL_PASSWORD_FILE names, the sender in TDHIL_MAIL_FROM")
    parser.add_argument("--check-idle", action="store_true",
                        help="before an upgrade: exit 0 if no run of --data is active, each stop is confirmed or signed"
                        " off, and no tdhil here holds a drive, else 4; nothing is served")
    parser.add_argument("--tls-cert", type=Path, metavar="PEM", help="the certificate, with its chain")
    parser.add_argument("--tls-key", type=Path, metavar="PEM", help="its key, without a password")
    parser.add_argument("--allowed-host", action="append", default=[], metavar="NAME",
                        help="another host name under which browsers reach this host; repeatable")
    parser.set_defaults(run=run)
    kinds = parser.add_subparsers(dest="kind", metavar="users|tokens|audit")
    _add_accounts(kinds, "users", "users, who log in with a password", passwd=True)
    _add_accounts(kinds, "tokens", "machines, which send a token", passwd=False)
    audit = kinds.add_parser("audit", allow_abbrev=False, help="check the audit's chain, and print its head",
                             description="Check the audit's chain, and print its head (NUMBER:HASH). Keep it on another"
                             " computer.")
    audit.add_argument("--head", metavar="NUMBER:HASH", help="an exported head to check the chain against")
    audit.add_argument("--data", type=Path, metavar="DIR", default=argparse.SUPPRESS,
                       help=f"the service's folder (default: {DATA})")
    audit.set_defaults(run=run_audit)


def _add_accounts(kinds: argparse._SubParsersAction[argparse.ArgumentParser], kind: str, what: str, *, passwd: bool,
                  ) -> None:
    from tdhil.service import ROLES

    parser = kinds.add_parser(kind, help=what, description=what[0].upper() + what[1:] + ".", allow_abbrev=False)
    actions = parser.add_subparsers(dest="action", metavar="ACTION", required=True)
    added = actions.add_parser("add", allow_abbrev=False,
                               help="add one; the password is prompted for, or read from stdin" if passwd
                               else "make one; it is shown only once")
    listed = actions.add_parser("list", allow_abbrev=False, help="list them")
    removed = actions.add_parser("remove", allow_abbrev=False, help="remove one; its sessions end within a second")
    changed = [actions.add_parser("passwd", allow_abbrev=False, help="set another password; ends all sessions")
               ] if passwd else []
    for one in (added, removed, *changed):
        one.add_argument("name", metavar="NAME")
    added.add_argument("--role", choices=ROLES, required=True,
                       help="viewer: view, download, stop; operator: runs, replays; engineer: unverified entries,"
                            " signatures; admin: accounts, audit")
    for one in (added, listed, removed, *changed):
        one.add_argument("--data", type=Path, metavar="DIR", default=argparse.SUPPRESS,
                         help=f"the service's folder (default: {DATA})")
        one.set_defaults(run=run_accounts)


def run(namespace: argparse.Namespace) -> int:
    """Serve until Ctrl-C or SIGTERM, which also stop all runs."""
    from tdhil.errors import UsageError
    from tdhil.service import MEBIBYTE, MOST_UPLOAD, Receivers, Tls, check_idle, serve

    if not 0 <= namespace.port <= 65535:
        raise UsageError("must be 0 to 65535", where=f"--port {namespace.port}", entry=MessageCode.VALUE_NOT_ALLOWED)
    if not 1 <= namespace.upload_limit <= MOST_UPLOAD // MEBIBYTE:
        raise UsageError(f"must be 1 to {MOST_UPLOAD // MEBIBYTE}", where=f"--upload-limit {namespace.upload_limit}",
                         entry=MessageCode.VALUE_NOT_ALLOWED)
    cert, key = namespace.tls_cert, namespace.tls_key
    if (cert is None) != (key is None):
        raise UsageError("needs --tls-cert and --tls-key together", where="--tls-cert" if key is None else "--tls-key",
                         entry=MessageCode.SERVICE_OPTION_WRONG)

    def say(text: str) -> None:
        print(visible(text, keep="\n"), file=sys.stderr, flush=True)  # noqa: T201

    if namespace.check_idle:
        return check_idle(namespace.data, say)
    viewers = frozenset(one.rstrip("/").lower() for one in namespace.viewer)
    return serve(namespace.rigs, namespace.data, namespace.host, namespace.port, say, viewers=viewers,
                 receivers=Receivers(namespace.mqtt, namespace.webhook, namespace.mail),
                 tls=None if cert is None else Tls(cert, key), names=namespace.allowed_host,
                 logs=namespace.logs, upload_limit=namespace.upload_limit * MEBIBYTE)


def _refuse_of_serving(namespace: argparse.Namespace) -> None:
    """Raise UsageError if options of the serving itself stand before users, tokens or audit: they have no effect."""
    from tdhil.errors import UsageError

    serving = argparse.ArgumentParser(allow_abbrev=False)
    add_arguments(serving)
    given = [f"--{name.replace('_', '-')}" for name, usual in vars(serving.parse_args([])).items()
             if name not in ("data", "kind", "run") and getattr(namespace, name) != usual]
    if given:
        raise UsageError(f"has no effect with {namespace.kind}", where=" ".join(given),
                         next_step="Nothing was done. Leave it out", entry=MessageCode.SERVICE_OPTION_WRONG)


def run_accounts(namespace: argparse.Namespace) -> int:
    """Add, list or remove accounts, or set a password; a running service applies the change within a second."""
    from tdhil.errors import UsageError
    from tdhil.service import AccountsFile, require_folder

    _refuse_of_serving(namespace)
    if namespace.action == "add":
        try:
            namespace.data.mkdir(parents=True, exist_ok=True, mode=0o750)
        except OSError as error:
            raise UsageError(f"can't be made ({error.strerror or error})", where=f"--data {namespace.data}",
                             next_step="Name a writable folder", entry=MessageCode.FILE_NOT_WRITABLE) from error
    require_folder(namespace.data)
    accounts = AccountsFile(namespace.data.resolve())
    users = namespace.kind == "users"
    first = not accounts.read()
    if namespace.action == "list":
        for one in (accounts.known.users if users else accounts.known.tokens).values():
            print(f"{one.name:<33}{one.role:<10}{one.since}")  # noqa: T201
        if first:
            print(f"{namespace.data} has no accounts, and is served to this computer only.",  # noqa: T201
                  file=sys.stderr)
        return 0
    if namespace.action == "add" and users:
        accounts.add_user(namespace.name, namespace.role, _password())
    elif namespace.action == "add":
        token = accounts.add_token(namespace.name, namespace.role)
        print("It is shown only once. Send it as: Authorization: Bearer …", file=sys.stderr)  # noqa: T201
        print(token)  # noqa: T201
    elif namespace.action == "passwd":
        accounts.set_password(namespace.name, _password())
    elif users:
        accounts.remove_user(namespace.name)
    else:
        accounts.remove_token(namespace.name)
    if first:
        print("From now on tdhil serve requires a login for this folder, and needs --tls-cert and --tls-key.",  # noqa: T201
              file=sys.stderr)
    return 0


def run_audit(namespace: argparse.Namespace) -> int:
    """Print the head of the audit's chain. Raises LogBroken if the chain is broken."""
    from tdhil.errors import LogBroken
    from tdhil.service import Audit, ChainHead, require_folder

    _refuse_of_serving(namespace)
    require_folder(namespace.data)
    audit = Audit(namespace.data.resolve() / "audit")
    kept = None if namespace.head is None else ChainHead.of(namespace.head)
    if (broken := audit.verify(kept)) is not None:
        place = f"{broken.file}:{broken.line}" if broken.file else str(namespace.data)
        raise LogBroken(f"the audit's chain is broken: {broken.why}", where=place,
                        next_step="Keep the folder as it is. Compare it with a backup", entry=MessageCode.AUDIT_BROKEN)
    head, made = audit.head(), audit.made()
    if head is None:
        print("The audit has no lines yet.", file=sys.stderr)  # noqa: T201
        return 0
    print(f"The chain is intact: {head.number} lines, its key was made {made}. Keep this head on another computer:",  # noqa: T201
          file=sys.stderr)
    print(head)  # noqa: T201
    return 0


def _password() -> str:
    """Return a password, typed twice, or a line of stdin if it is not a terminal. Raises UsageError."""
    import getpass

    from tdhil.errors import UsageError

    if sys.stdin is None or not sys.stdin.isatty():
        return "" if sys.stdin is None else sys.stdin.readline().rstrip("\r\n")
    given = getpass.getpass("Password: ")
    if getpass.getpass("Repeat the password: ") != given:
        raise UsageError("the two passwords differ", where="password", next_step="Try again",
                         entry=MessageCode.ACCOUNT_WRONG)
    return given
