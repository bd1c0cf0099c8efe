"""Hands that viewers move by velocities, with keys or a gamepad: `HandControl` for the viewer who has the controls.

A velocity lasts only a moment, so that a hand stops if its viewer's page stops.
"""

from __future__ import annotations

import asyncio
import time
from typing import TYPE_CHECKING

import anyio
import numpy as np

from urlab_client.console.controls import Controls
from urlab_client.console.lease import DrivingLease, NotDriving, Viewer
from urlab_client.console.messages import Hand
from urlab_client.console.shared_view import SharedView
from urlab_client.errors import URLabError

if TYPE_CHECKING:
    import mujoco

    from urlab_client.aio import URLabClient
    from urlab_client.integrations.teleop import HandControl

_PERIOD_S = 0.02
_LASTS_S = 0.25
_FAR_M = 0.15  # from the target: something else has moved the hand


class HandDriving:
    """The hands of one console."""

    def __init__(self, client: URLabClient, lease: DrivingLease, controls: Controls, view: SharedView) -> None:
        self._client = client
        self._lease = lease
        self._controls = controls
        self._view = view
        self._model: mujoco.MjModel | None = None
        self._hands: dict[str, HandControl] = {}
        self._orders: dict[str, tuple[float, Viewer, Hand]] = {}
        self._moving: set[str] = set()
        self._ordered = asyncio.Event()

    def command(self, viewer: Viewer, order: Hand) -> None:
        """Move a hand for a moment."""
        if any((*order.linear, *order.angular, order.gripper)):
            self._lease.use(viewer)
            self._hand(viewer, order.articulation, order.site)
            if order.articulation not in self._orders:
                self._view.note("call", viewer.name, "drive hand", order.articulation)
            self._orders[order.articulation] = time.monotonic(), viewer, order
            self._ordered.set()
        else:
            self._orders.pop(order.articulation, None)

    async def keep_driving(self) -> None:
        """Move the hands that have orders."""
        began = time.monotonic()
        while True:
            if not self._orders:
                self._ordered.clear()
                await self._ordered.wait()
                began = time.monotonic()
            await anyio.sleep(max(0.0, began + _PERIOD_S - time.monotonic()))
            now = time.monotonic()
            passed, began = min(now - began, _LASTS_S), now
            for key, (at, viewer, order) in list(self._orders.items()):
                if now - at > _LASTS_S:
                    del self._orders[key]
                    continue
                try:
                    self._drive(viewer, order, passed)
                except (NotDriving, URLabError, ValueError, KeyError) as error:
                    del self._orders[key]
                    self._view.note("error", viewer.name, "hand", str(error))
            self._moving &= set(self._orders)

    def _drive(self, viewer: Viewer, order: Hand, seconds: float) -> None:
        self._lease.use(viewer)  # before anything is written, as another viewer may drive by now
        key = order.articulation
        hand = self._hand(viewer, key, order.site)
        if key not in self._moving and self._elsewhere(hand):
            hand.hold()
        self._moving.add(key)
        hand.drive(order.linear, order.angular, order.gripper, dt=seconds)
        self._controls.set_points(viewer, {key: hand.set_points}, noted=False)

    def _elsewhere(self, hand: HandControl) -> bool:
        """Whether something else has moved the hand since, or set its set-points: a reset, a slider, a policy."""
        present = self._client.articulations[hand.key].get_ctrl()
        changed = any(abs(present[name] - value) > 1e-9 for name, value in hand.set_points.items())
        return changed or float(np.linalg.norm(hand.ik.pose()[0] - hand.target[0])) > _FAR_M

    def _hand(self, viewer: Viewer, key: str, site: str) -> HandControl:
        if self._client.model is not self._model:
            self._hands.clear()
            self._model = self._client.model
        hand = self._hands.get(f"{key}/{site}")
        if hand is None:
            try:
                from urlab_client.integrations.teleop import HandControl

                self._controls.set_points(viewer, {key: {}})  # before it holds the joints: holds the others
                hand = self._hands[f"{key}/{site}"] = HandControl(self._client, key, site=site or None)
            except (URLabError, ImportError) as error:
                raise ValueError(str(error)) from error
        return hand
