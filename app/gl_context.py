"""OpenGL contexts: with and without a window, and whether a GPU or a software driver stands behind them."""

from __future__ import annotations

import sys

import moderngl

from cap4d.errors import Cap4dError

REQUIRED = 410  # OpenGL 4.1 core: macOS stops here
SOFTWARE_RENDERERS = (
    "llvmpipe", "lavapipe", "softpipe", "swrast", "swiftshader", "gdi generic", "basic render", "apple soft",
)  # fmt: skip


class GlUnavailableError(Cap4dError):
    """This machine offers no OpenGL 4.1 context."""


def headless_context() -> moderngl.Context:
    """A context that needs no display: EGL on Linux, the system's own way elsewhere.

    Raises:
        GlUnavailableError: There is no driver for one.
    """
    backend = {"backend": "egl"} if sys.platform.startswith("linux") else {}
    return _context(standalone=True, **backend)


def window_context() -> moderngl.Context:
    """Takes over the context that is current in this thread (glfw's).

    Raises:
        GlUnavailableError: It is older than OpenGL 4.1.
    """
    return _context()


def is_software(ctx: moderngl.Context) -> bool:
    """Whether the CPU draws. cap4d's own CPU renderer then is several times faster than OpenGL."""
    renderer = ctx.info["GL_RENDERER"].lower()
    return any(name in renderer for name in SOFTWARE_RENDERERS)


def _context(**settings: object) -> moderngl.Context:
    try:
        ctx = moderngl.create_context(require=REQUIRED, **settings)
    except Exception as error:  # glcontext raises plain Exception
        raise GlUnavailableError(f"OpenGL: expected a driver for 4.1 core, found none ({error})") from error
    ctx.gc_mode = "context_gc"  # dropped objects wait for `ctx.gc()`; none is deleted after its context
    return ctx
