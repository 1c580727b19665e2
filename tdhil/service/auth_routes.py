"""The routes for logins, users and machines. Passwords are checked one at a time."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any, TypeVar

import anyio
from starlette.responses import JSONResponse, Response

from tdhil.errors import MessageCode, UsageError
from tdhil.service.access import Principal, address_of, principal, set_cookies
from tdhil.service.accounts import ROLES, AccountNameRefused, PasswordRefused, Token, User
from tdhil.service.middleware import off
from tdhil.service.routing import apis
from tdhil.service.run_state import NotLoggedIn, TooManyTries, iso
from tdhil.service.schemas import AccountsView, AccountView, MeView, TokenView, plain
from tdhil.service.start_request import ValuesWrong

if TYPE_CHECKING:
    from starlette.requests import Request
    from starlette.routing import Route

    from tdhil.service.site import Site

T = TypeVar("T")


def routes(site: Site) -> list[Route]:
    """Return the routes of logins, users and tokens."""
    return apis(
        site, me, login, logout, password, accounts, add_user, set_password, remove_user, add_token,
        remove_token)


def _me_view(site: Site, who: Principal) -> MeView:
    ends_s = site.access.ends_s(who)
    return MeView(who.name, [role for role in ROLES if role in who.roles], site.access.login,
                  None if ends_s is None else iso(ends_s))


async def me(site: Site, request: Request, body: Any) -> MeView:
    """Return the client as the service identifies it."""
    return _me_view(site, principal(request))


async def login(site: Site, request: Request, body: Any) -> Response:
    """Start a session. Raises NotLoggedIn and TooManyTries."""
    if not site.access.login:
        raise UsageError("this service has no accounts", where="login",
                         next_step="Add a user on the terminal: tdhil serve users add NAME --data DIR",
                         entry=MessageCode.ACCOUNT_WRONG)
    cookie, who = await _slowly(site, request, body.name.strip().lower()[:64], body.password)
    site.supervisor.note(who.name, "logged in", None, None, address=address_of(request))
    response = JSONResponse(plain(_me_view(site, who), MeView))
    set_cookies(response, request, cookie)
    return response


async def _slowly(site: Site, request: Request, name: str, password: str) -> tuple[str, Principal]:
    """Check a password in a thread, since this is slow. Raises NotLoggedIn and TooManyTries."""
    address = address_of(request)
    if site.logins.statistics().tasks_waiting >= 10:
        raise TooManyTries(10.0)
    try:
        found: tuple[str, Principal] = await anyio.to_thread.run_sync(
            partial(site.access.log_in, name, password, address), limiter=site.logins)
        return found
    except NotLoggedIn:
        site.supervisor.note("nobody", "login refused", None, None, name=name, address=address)
        raise


async def logout(site: Site, request: Request, body: Any) -> Response:
    """End the session."""
    who = principal(request)
    if who.session:
        await off(lambda: site.access.log_out(request))
        site.supervisor.note(who.name, "logged out", None, None)
    response = JSONResponse(plain(_me_view(site, site.access.who(request)), MeView))
    set_cookies(response, request, None)
    return response


async def password(site: Site, request: Request, body: Any) -> MeView:
    """Change the user's own password."""
    who = principal(request)
    if not who.session:
        raise UsageError("only a logged-in user has a password", where="password", entry=MessageCode.ACCOUNT_WRONG)
    try:
        await _slowly(site, request, who.name, body.old)
    except NotLoggedIn:
        raise ValuesWrong([("old", "the old password is wrong")]) from None
    await _account(site, request, lambda: site.access.accounts.set_password(who.name, body.new), "password set",
                   who.name, "new")
    return _me_view(site, site.access.who(request))


async def _account(site: Site, request: Request, change: Callable[[], T], what: str, name: str,
                   password: str = "password") -> T:
    """Change an account, one at a time, and note it in the audit. Raises UsageError; ValuesWrong for a name or a
    password that is refused. ``password``: field of the password.
    """
    if not site.access.login:
        raise UsageError("the first user is added on the terminal", where="accounts",
                         next_step="tdhil serve users add NAME --role admin --data DIR; then start with a certificate",
                         entry=MessageCode.ACCOUNT_WRONG)
    try:
        found: T = await anyio.to_thread.run_sync(change, limiter=site.logins)
    except (AccountNameRefused, PasswordRefused) as error:
        field = password if isinstance(error, PasswordRefused) else "name"
        raise ValuesWrong([(field, error.what + (f". {error.next_step}" if error.next_step else ""))]) from None
    site.supervisor.note(principal(request).name, what, None, None, name=name)
    return found


async def accounts(site: Site, request: Request, body: Any) -> AccountsView:
    """Return users and machines."""
    return _accounts_view(site)


def _accounts_view(site: Site) -> AccountsView:
    known = site.access.accounts.known
    return AccountsView([_account_view(one) for one in known.users.values()],
                        [_account_view(one) for one in known.tokens.values()])


async def add_user(site: Site, request: Request, body: Any) -> AccountView:
    """Add a user."""
    accounts = site.access.accounts
    return _account_view(await _account(
        site, request, lambda: accounts.add_user(body.name, body.role, body.password), "user added", body.name))


async def set_password(site: Site, request: Request, body: Any) -> AccountView:
    """Set the password of a user."""
    accounts, name = site.access.accounts, request.path_params["user"]
    return _account_view(await _account(
        site, request, lambda: accounts.set_password(name, body.password), "password set", name))


async def remove_user(site: Site, request: Request, body: Any) -> AccountsView:
    """Remove a user, but not the last admin."""
    accounts, name = site.access.accounts, request.path_params["user"]
    await _account(site, request, lambda: accounts.remove_user(name, keep_admin=True), "user removed", name)
    return _accounts_view(site)


async def add_token(site: Site, request: Request, body: Any) -> TokenView:
    """Add a token of a machine."""
    token = await _account(
        site, request, lambda: site.access.accounts.add_token(body.name, body.role), "token added", body.name)
    return TokenView(body.name, body.role, token)


async def remove_token(site: Site, request: Request, body: Any) -> AccountsView:
    """Remove a token."""
    accounts, name = site.access.accounts, request.path_params["token"]
    await _account(site, request, lambda: accounts.remove_token(name), "token removed", name)
    return _accounts_view(site)


def _account_view(one: User | Token) -> AccountView:
    return AccountView(one.name, one.role, one.since)
