"""The routes for logins, users and machines. Passwords are checked one at a time.

Each of `ANSWERS` is called with the site, the request and its body, like the web's own routes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import TYPE_CHECKING, Any, Final, TypeVar

import anyio
from starlette.responses import JSONResponse, Response

from tdhil.errors import MessageCode, UsageError
from tdhil.service.access import Principal, address_of, principal, set_cookies
from tdhil.service.accounts import ROLES, Token, User
from tdhil.service.middleware import Answer, Site, off
from tdhil.service.run_state import NotLoggedIn, TooManyTries, iso
from tdhil.service.schemas import AccountsView, AccountView, MeView, TokenView, plain

if TYPE_CHECKING:
    from starlette.requests import Request

T = TypeVar("T")


def _me_view(site: Site, who: Principal) -> MeView:
    ends_s = site.access.ends_s(who)
    return MeView(who.name, [role for role in ROLES if role in who.roles], site.access.login,
                  None if ends_s is None else iso(ends_s))


async def _me(site: Site, request: Request, body: Any) -> MeView:
    return _me_view(site, principal(request))


async def _login(site: Site, request: Request, body: Any) -> Response:
    if not site.access.login:
        raise UsageError("this service has no accounts", where="login",
                         next_step="Add a user on the terminal: tdhil serve users add", entry=MessageCode.ACCOUNT_WRONG)
    cookie, who = await _slowly(site, request, body.name.strip().lower()[:64], body.password)
    site.supervisor.note(who.name, "logged in", None, None, address=address_of(request))
    response = JSONResponse(plain(_me_view(site, who), MeView))
    set_cookies(response, request, cookie)
    return response


async def _slowly(site: Site, request: Request, name: str, password: str) -> tuple[str, Principal]:
    """Check a password. Raises NotLoggedIn and TooManyTries."""
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


async def _logout(site: Site, request: Request, body: Any) -> Response:
    who = principal(request)
    if who.session:
        await off(lambda: site.access.log_out(request))
        site.supervisor.note(who.name, "logged out", None, None)
    response = JSONResponse(plain(_me_view(site, site.access.who(request)), MeView))
    set_cookies(response, request, None)
    return response


async def _password(site: Site, request: Request, body: Any) -> MeView:
    who = principal(request)
    if not who.session:
        raise UsageError("only a logged-in user has a password", where="password", entry=MessageCode.ACCOUNT_WRONG)
    try:
        await _slowly(site, request, who.name, body.old)
    except NotLoggedIn:
        raise UsageError("the old password is wrong", where="old", entry=MessageCode.ACCOUNT_WRONG) from None
    await _account(site, request, lambda: site.access.accounts.set_password(who.name, body.new), "password set",
                   who.name)
    return _me_view(site, site.access.who(request))


async def _account(site: Site, request: Request, change: Callable[[], T], what: str, name: str) -> T:
    """Change an account, one at a time, and note it in the audit. Raises UsageError."""
    if not site.access.login:
        raise UsageError("the first user is added on the terminal", where="accounts",
                         next_step="tdhil serve users add NAME --role admin; then start with a certificate",
                         entry=MessageCode.ACCOUNT_WRONG)
    found: T = await anyio.to_thread.run_sync(change, limiter=site.logins)
    site.supervisor.note(principal(request).name, what, None, None, name=name)
    return found


async def _accounts(site: Site, request: Request, body: Any) -> AccountsView:
    return _accounts_view(site)


def _accounts_view(site: Site) -> AccountsView:
    known = site.access.accounts.known
    return AccountsView([_account_view(one) for one in known.users.values()],
                        [_account_view(one) for one in known.tokens.values()])


async def _add_user(site: Site, request: Request, body: Any) -> AccountView:
    accounts = site.access.accounts
    return _account_view(await _account(
        site, request, lambda: accounts.add_user(body.name, body.role, body.password), "user added", body.name))


async def _set_password(site: Site, request: Request, body: Any) -> AccountView:
    accounts, name = site.access.accounts, request.path_params["user"]
    return _account_view(await _account(
        site, request, lambda: accounts.set_password(name, body.password), "password set", name))


async def _remove_user(site: Site, request: Request, body: Any) -> AccountsView:
    accounts, name = site.access.accounts, request.path_params["user"]
    await _account(site, request, lambda: accounts.remove_user(name, keep_admin=True), "user removed", name)
    return _accounts_view(site)


async def _add_token(site: Site, request: Request, body: Any) -> TokenView:
    token = await _account(
        site, request, lambda: site.access.accounts.add_token(body.name, body.role), "token added", body.name)
    return TokenView(body.name, body.role, token)


async def _remove_token(site: Site, request: Request, body: Any) -> AccountsView:
    accounts, name = site.access.accounts, request.path_params["token"]
    await _account(site, request, lambda: accounts.remove_token(name), "token removed", name)
    return _accounts_view(site)


def _account_view(one: User | Token) -> AccountView:
    return AccountView(one.name, one.role, one.since)


ANSWERS: Final[Mapping[str, Answer]] = {
    one.__name__.removeprefix("_"): one for one in (
        _me, _login, _logout, _password, _accounts, _add_user, _set_password, _remove_user, _add_token, _remove_token,
    )
}
"""Answers by route name."""
