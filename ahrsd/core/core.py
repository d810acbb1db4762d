"""The pure core: inputs in, events out. `run` and `replay` feed it the same way.

It joins the parts and decides nothing itself: `device_session` talks to the device, `sample_source`
makes samples, `estimation` estimates and judges, the write-back says what may be written and
`write_back` carries that out. The core's time is that of the inputs. Whatever it answers depends on
the list of inputs alone, which is why a replay takes the same decisions; `decisions` holds them and
their hash.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from ahrsd import events, inputs
from ahrsd.core.clients import Clients
from ahrsd.core.decision_log import DecisionLog
from ahrsd.core.device_session import (
    Closed,
    Completed,
    ConfigurationRead,
    DeviceEvent,
    DeviceSession,
    Identified,
    Looked,
    Served,
    StreamChanged,
    Unanswered,
)
from ahrsd.core.estimation import (
    Calibrator,
    Circumstances,
    Estimation,
    EstimationFailure,
    EstimationResult,
    EstimationTask,
)
from ahrsd.core.sample_source import Doubt, SampleSource, SampleWarning
from ahrsd.core.settings import CoreSettings
from ahrsd.core.warm_start import Present, WarmStart
from ahrsd.core.write_back import ActionQueue, DeviceRecord, OperatorAnswers, TrialComparison
from ahrsd.samples import SampleBlock
from ahrsd.writeback.machine import WriteBack
from ahrsd.writeback.states import Mode, State
from drivers.vn100.registers import Values
from drivers.vn100.session import DeviceFault
from drivers.vn100.session import Event as SessionEvent

_WATCHDOG_RESET, _HARD_FAULT = 0x0A, 0x01  # VNERR codes


class Core:
    """See the module. Not thread-safe."""

    def __init__(self, settings: CoreSettings) -> None:
        self.settings = settings
        self.decisions = DecisionLog(settings.keep)
        passive = settings.policy.mode is Mode.PASSIVE
        # the device, and what comes from it
        self.source: SampleSource[Circumstances] = SampleSource(settings)
        self.stream = self.source.stream
        self.device_session = DeviceSession(
            settings.policy.mode,
            change_stream=settings.policy.configure_stream,
            rate_hz=settings.output_rate_hz,
            reply_timeout_s=settings.reply_timeout_s,
        )
        # what is estimated of it
        self.estimation = Estimation(settings.calibrator, self._begin_task)
        self.warm = WarmStart(settings.warm_start_s, passive=passive)
        # what may be written by that
        self.writeback = WriteBack(settings.policy)
        self._action_queue = ActionQueue(self.device_session, self.writeback, self.stream.forgive)
        self._device_record = DeviceRecord()
        self._trial = TrialComparison(self.writeback)
        self._answers = OperatorAnswers()
        self.clients = Clients(settings.shares, self.device_session, self.writeback)
        self.at_s = self._host_s = 0.0
        self.first_s = float("nan")
        self.faults = self._breaks = 0
        self._stopping, self._judged_anew = "", 0
        self._closing = self._unread = False
        self._out: list[events.Event] = []
        if passive:
            self._no_device()
        device, back, add = self.device_session, self.writeback, self._action_queue.add
        self._handlers: dict[type, Callable[..., None]] = {
            inputs.Received: lambda it: self.take(device.received(it.data, self._host_s)),
            inputs.Tick: lambda _: self.take(device.tick(self._host_s)),
            inputs.WallClock: self._wall_clock,
            inputs.LinkOpened: self._link_opened,
            inputs.LinkLost: self._link_lost,
            inputs.Interlock: lambda it: add(back.on_interlock(it.safe, self._host_s)),
            inputs.Operator: self._operator,
            inputs.ClientSent: lambda it: self.clients.sent(it, self._host_s),
            inputs.ClientLeft: self.clients.left,
            **dict.fromkeys((inputs.Columns, inputs.TermsKnown), self.source.vehicle.take),
            inputs.RegistersKnown: self._registers_known,
            inputs.Samples: self._samples_given,
            inputs.EarlierSamples: self.warm.sampled,
            inputs.EarlierRun: lambda it: self._say_warm(self.warm.ended(it)),
            inputs.JournalOpened: self._journal_opened,
            inputs.Journalled: self._journalled,
            inputs.Examined: lambda it: self._take_results(it.pieces, it.failure),
            inputs.LimitsChanged: self._limits_changed,
            inputs.Stop: self._stop,
        }

    # -- the two calls of a shell ------------------------------------------------------------------

    def handle(self, item: inputs.Input) -> list[events.Event]:
        """Take one input; everything that follows from it, in order."""
        self._host_s = max(self._host_s, item.host_ns * 1e-9)
        self._action_queue.let_out(self)
        # first of all: what is sent next is judged by how old the vehicle's word is *now*
        self._action_queue.add(self.writeback.tick(self._host_s))
        self._handlers[type(item)](item)
        self._drive()
        if not self._action_queue.awaiting_journal:
            self._out += self._answers.take()
        out, self._out = self._out, []
        return out

    @property
    def deadline_ns(self) -> int | None:
        """When a `Tick` is wanted if nothing else arrives before, on the host's clock."""
        parts = (self.device_session, self.writeback, self.clients)
        due = [part.deadline_s for part in parts]
        known = [d for d in due if d is not None]
        return int(min(known) * 1e9) + 1 if known else None

    # -- what others see of it ---------------------------------------------------------------------

    @property
    def registers(self) -> dict[int, Values]:
        """The device's registers, as far as they are known."""
        return self.source.registers

    @property
    def calibrator(self) -> Calibrator:
        """The calibrator in use."""
        return self.estimation.calibrator

    @calibrator.setter
    def calibrator(self, calibrator: Calibrator) -> None:
        self.estimation.calibrator = calibrator

    # -- inputs ------------------------------------------------------------------------------------

    def _wall_clock(self, item: inputs.WallClock) -> None:
        add, back = self._action_queue.add, self.writeback
        self.warm.clock(item)
        add(back.on_clock(item.wall_s, item.boot_id, item.boot_s, self._host_s))

    def _link_opened(self, item: inputs.LinkOpened) -> None:
        latency = "" if item.latency_ms is None else f", USB latency {item.latency_ms} ms"
        self._note("info", f"{item.port} open at {item.baud} baud{latency}")
        self.stream.forget()
        if self.device_session.mode is Mode.PASSIVE:
            self._no_device()
        else:
            self.source.epochs.begin_anew()  # nothing is un-mapped before it is known how
        self.take(self.device_session.opened(item.baud, self._host_s))

    def _link_lost(self, item: inputs.LinkLost) -> None:
        self._flush()
        self._breaks += 1
        self._note("warning", f"link lost: {item.reason}")
        self.take(self.device_session.lost(self._host_s))
        self.stream.forget()
        self.source.unconfirmed.drop()
        self._action_queue.forget_procedure()
        self._action_queue.add(self.writeback.on_link_lost(self._host_s))

    def _operator(self, item: inputs.Operator) -> None:
        self._note("info", f"operator: {item.verb} {item.argument}".strip())
        back = self.writeback
        self._action_queue.add(back.on_operator(item.verb, item.argument, self._host_s))
        self._answers.add(item.word, back.operator_answer)

    def _journalled(self, item: inputs.Journalled) -> None:
        self._action_queue.journalled(item, self._host_s)
        self._answers.journalled(item)

    def _registers_known(self, item: inputs.RegistersKnown) -> None:
        self._flush()
        self._note("info", f"registers taken from {item.source}")
        self._in_force(dict(item.values))
        self._no_device()

    def _samples_given(self, item: inputs.Samples) -> None:
        self.stream.given(item.block)
        self._block(item.block)

    def _journal_opened(self, item: inputs.JournalOpened) -> None:
        if error := self._device_record.journal_read(item):
            self._note("error", f"journal: {error}; nothing can be written")
        self._device_known()

    def _limits_changed(self, item: inputs.LimitsChanged) -> None:
        self._judged_anew += 1
        self._note("info", "the limits of the gates were changed")
        calibrator = self.estimation.adopt(item.limits)
        self.settings = replace(self.settings, calibrator=calibrator)
        self._action_queue.add(self.writeback.on_limits_changed(self._host_s))

    def _stop(self, item: inputs.Stop) -> None:
        self._flush()
        self._stopping = item.reason
        self._action_queue.stop(self._host_s)

    # -- the device --------------------------------------------------------------------------------

    def take(self, found: list[SessionEvent]) -> None:
        """Measurements become samples, or a reason to doubt whose they are."""
        skipped = self.device_session.session.deframer.take_skipped()
        for item in self.source.take(found, skipped, self._host_s):
            match item:
                case SampleBlock():
                    self._block(item)
                case Doubt(reason):
                    self._doubt(reason)
                case SampleWarning(text):
                    self._note("warning", text)
                case DeviceFault(code):
                    self._fault(code)
        if self.source.take_restart():
            newest_s = self.stream.newest_s  # nobody knows whose it is: no proof of a restart
            started_s = self._host_s - (self.at_s if newest_s is None else newest_s)
            self._device_reset("its time fell", self.at_s, self.clients.reset_by(started_s))

    def _doubt(self, reason: str, *, jumped: bool = False) -> None:
        """From now on samples may be of another device, for this reason; empty: for none."""
        if reason and self.device_session.listening and self.device_session.identity is not None:
            self.warm.doubt()
            if not jumped:
                restarted = not self.stream.carries_time  # else its time would have fallen
                self.source.unconfirmed.doubt(self._host_s, perhaps_restarted=restarted)
            more = self.writeback.on_doubt(reason, self._host_s, jumped=jumped)
            self._action_queue.add(more)
            if jumped:
                self._trial.jumped(self.registers)

    def _fault(self, code: int) -> None:
        self.faults += 1
        self._note("warning", f"the device reports VNERR {code:02X}")
        self.clients.fault(code)
        if code in (_WATCHDOG_RESET, _HARD_FAULT):
            self._device_reset(f"VNERR {code:02X}")

    def _device_reset(self, why: str, uptime_s: float | None = None, client: str = "") -> None:
        self._note("warning", f"the device restarted ({why})")
        self._breaks += 1
        self.source.unconfirmed.drop()
        if self.device_session.identity is None:
            return
        if client:  # the vehicle goes on turning meanwhile: its readings do not jump
            self.source.output_resumed(self._host_s)
        self.source.in_doubt(self._host_s)
        self._action_queue.add(self.writeback.on_reset(self._host_s, uptime_s, client))
        self._action_queue.forget_procedure()
        self.take(self.device_session.identify_again(self._host_s))

    def _no_device(self) -> None:
        """Passive, or a recording without commands: the stream is taken as it is."""
        self._action_queue.add(self.writeback.on_no_device(self.registers or None, self._host_s))

    def _device_known(self) -> None:
        """Identity, registers and journal may all be there now."""
        self._action_queue.add(
            self._device_record.report(self.device_session, self.writeback, self._host_s)
        )

    def _in_force(self, values: dict[int, Values]) -> None:
        """Samples from now on passed these registers; the first ones are the estimator's prior."""
        self.source.in_force(values, self._host_s)
        # on trial, a candidate is still compared with what the user had before it
        trial = self.writeback.history.open
        self.estimation.compare_with(values if trial is None else {**values, **trial.old})

    def _identified(self, event: Identified) -> None:
        """A device said who it is; what was estimated of another one is not for it."""
        unit = event.identity.unit
        self._note("info", str(unit))
        if (before := self._device_record.identified(unit)) not in (None, unit):
            self._flush()
            self.source.paused(self._host_s)
            text = f"{before} was here before: the calibration begins anew for this one"
            self._note("warning", f"another device, {unit}; {text}")
            self.estimation.begin_from_scratch()
            self.warm.over("another device was here")
        self._out.append(events.OpenJournal(unit.serial))

    def _on_device(self, event: DeviceEvent) -> None:
        match event:
            case Identified():
                self._identified(event)
            case ConfigurationRead(values):
                self._flush()
                self.source.unconfirmed.drop()  # it was asked for because something is not sure
                believed = {} if self.writeback.history.open else self.registers
                if others := self._device_record.registers_read(values, believed, self._breaks):
                    self._note("warning", f"somebody changed registers {others}: calibrated anew")
                if self._unread or others:  # as it came does not mix with what is un-mapped
                    self.estimation.begin_from_scratch()
                    self._unread = False
                    self.warm.over("calibrated anew")
                self._in_force(values)
                self._out.append(events.RegistersRead(self._host_s, values))
                self._device_known()
            case Looked(seen, error):
                back = self.writeback
                self._action_queue.add(back.on_looked(seen, str(error or ""), self._host_s))
                if back.confirmed_s is not None:
                    for blocks, when in self.source.unconfirmed.confirm(back.confirmed_s):
                        self._examine(blocks, when)
            case Served(result, error):
                self._client_served(result, error)
            case StreamChanged(text, level):
                self._flush()
                self.source.paused(self._host_s)
                if text:
                    self._note(level, text)
            case Unanswered(text):
                self._unread = True
                self._note("warning", f"{text}; listening only, nothing can be written")
                self.source.unread(self._host_s)
                self._no_device()
            case Completed(name, result, error):
                self._flush()
                self.source.paused(self._host_s)
                if error is None:
                    more = self.writeback.on_procedure_finished(name, result, self._host_s)
                else:
                    more = self.writeback.on_procedure_failed(name, error, self._host_s)
                self._action_queue.add(more)
            case Closed(error):
                if error is not None:
                    self._note("error", f"not everything was put back: {error}")
                self._out.append(events.Finished(self._stopping))

    # -- what the write-back wants -----------------------------------------------------------------

    def _drive(self) -> None:
        """Let device session and write-back answer each other until neither has anything left."""
        while True:
            found = self.device_session.take_events()
            for event in found:
                self._on_device(event)
            acted = self._action_queue.work(self, self._host_s)
            acted |= self._serve_clients()
            if self._stopping and not self._closing and self._action_queue.at_rest:
                self._closing = acted = True
                self.take(self.device_session.restore_and_close(self._host_s))
            if not found and not acted:
                break
        if output := self.device_session.session.take_output():
            self._out.append(events.Send(output))
        for text in self.clients.take_notes():
            self._note("warning", text)
        self._out += self.clients.take_answers()

    def _serve_clients(self) -> bool:
        """Let a client's command have the wire; returns whether anything was done."""
        free = not (self._action_queue.wants_the_wire or self._stopping)
        actions, turn = self.clients.next(self._host_s, free=free)
        self._action_queue.add(actions)
        if turn is not None:
            asked = turn.asked
            self.take(
                self.device_session.serve(asked.command, self._host_s, asked.purpose, turn.known)
            )
        return bool(actions) or turn is not None

    def _client_served(self, result: object, error: Exception | None) -> None:
        """What a client's command changed in the device."""
        served = self.clients.served(result, error, self.registers, self._host_s)
        if served.wrote:
            self._flush()
            self.source.wrote(served.wrote)
            self.source.paused(self._host_s)
        self._action_queue.add(served.actions)
        if served.reset_by:
            self._device_reset(f"{served.reset_by} reset it", client=served.reset_by)

    def emit(self, event: events.Event) -> None:
        """A fact of the write-back."""
        self._out.append(event)
        if isinstance(event, events.StateChanged):
            self._on_state(event)

    def in_force(self, registers: Mapping[int, Values] | None) -> None:
        """The device applies these registers from now on; None: unknown, a write is under way."""
        self._flush()
        if registers is None:
            self.source.in_doubt(self._host_s)
        else:
            self._in_force(dict(registers))

    def calibrate_anew(self, reason: str) -> None:
        """Nobody knows since when the registers that un-map the samples are not in force."""
        self._flush()
        self._unread = True  # from scratch as soon as they are read
        self._breaks += 1
        self._note("warning", f"calibrated anew: {reason}")

    def _on_state(self, change: events.StateChanged) -> None:
        self.decisions.add(self.at_s, change.new, reason=change.reason)
        self._trial.changed(change, self.registers)

    # -- samples -----------------------------------------------------------------------------------

    def _flush(self) -> None:
        for block in self.stream.flush():
            self._block(block)

    def _block(self, block: SampleBlock) -> None:
        self.at_s = float(block.time_s[-1])
        self.first_s = float(block.time_s[0]) if np.isnan(self.first_s) else self.first_s
        if self.source.tells_uptime:
            heard_s = min(float(block.host_s[-1]), self._host_s)
            self._action_queue.add(self.writeback.on_uptime(self.at_s, self._host_s, heard_s))
        if self.stream.take_replaced():
            self.source.unconfirmed.drop()
            self.estimation.begin_anew()
            self.warm.again()
        if self.clients.resetting:  # its answer may have come with these readings
            self.source.output_resumed(self._host_s)
        reason, jumped = self.source.suspicion(block)
        self._doubt(reason, jumped=jumped)
        block, present = self.source.vehicle.with_columns(block), self.source.present_correction
        self._out.append(events.SamplesSeen(block, present, self.estimation.proposed))
        self._action_queue.add(self.writeback.on_samples(block))
        for text in self.source.sensors.take(block):
            self._note("warning", text)
        if (free := self.source.vehicle.without_terms(block)) is not None:
            self._action_queue.add(self._trial.take(free, self._host_s))
            self._to_estimate(free)
        self._action_queue.let_out(self)

    def _to_estimate(self, block: SampleBlock) -> None:
        """For the calibrator at once, or once the device has answered behind them."""
        now = self._circumstances(self._host_s or self.at_s)
        if self.device_session.identity is None or self.device_session.mode is Mode.PASSIVE:
            self._examine([block], now)  # there is nobody to ask
            return
        waiting = self.source.unconfirmed
        waiting.hold(block, self._host_s, now)
        self._action_queue.add(self.writeback.on_waiting(waiting.span_s, self._host_s))

    def _circumstances(self, host_s: float) -> Circumstances:
        basis = self.source.basis(self.device_session.identity)
        margin, era = self.writeback.margin, self._era()
        return Circumstances(self.at_s, host_s, self.stream.health(), basis, margin, era)

    def _examine(self, blocks: list[SampleBlock], when: Circumstances) -> None:
        """Samples of the device that was read: for the calibrator."""
        if taken := [block for block in blocks if self.estimation.state.takes(block)]:
            taken[0] = self._recall(taken[0])
            for block in taken:
                self.warm.live(block)
            self.estimation.examine(taken, when)

    def _recall(self, block: SampleBlock) -> SampleBlock:
        """The block, after the calibrator was given the samples of an earlier run, if any."""
        if not self.warm.pending or self.writeback.state is State.RECONCILING:
            return block
        epoch = self.source.epochs.now
        identity, read = self.device_session.identity, epoch.compensation is not None
        present = Present(
            identity.unit if identity is not None and read else None,
            self.registers,
            (self.stream.compensated_mag, self.stream.compensated_gyro),
            self.at_s,
            self._host_s,
            open=self.writeback.history.open is not None,
            candidate=self.writeback.proposal is not None,
            terms=bool(self.source.vehicle.terms),
        )
        blocks, text = self.warm.due(present, float(block.time_s[0]))
        self._say_warm(text)
        if not blocks:
            return block
        ours = [replace(old, epoch=epoch.number) for old in blocks]
        self.estimation.recall(ours, self._circumstances(self._host_s))
        self._action_queue.add(self.writeback.on_doubt("samples of an earlier run", self._host_s))
        unknown = np.concatenate([[np.nan], block.dt_s[1:]])
        return replace(block, dt_s=unknown, gap_before=True)

    def _say_warm(self, text: str) -> None:
        if text:
            self._note("info", text)

    def _begin_task(self, task: EstimationTask) -> None:
        """Hand the task to the estimation thread, or do it now."""
        if self.settings.beside:
            self._out.append(events.Examine(task.work))
        else:
            self._take_results(1)

    def _take_results(self, tasks: int, failure: str = "") -> None:
        for found in self.estimation.results(tasks, failure):
            if isinstance(found, EstimationFailure):
                self._estimator_failed(found.reason)
                continue
            self._out += found.notes
            back, when = self.writeback, found.when
            if found.void:
                self.warm.doubt()
                self._action_queue.add(back.on_void(found.void, when.at_s, self._host_s))
            self._judged(found)
            self._action_queue.add(back.on_examined(when.host_s, self._host_s))

    def _estimator_failed(self, reason: str) -> None:
        """Drop the calibrator and what it proposed; a new one starts after a pause."""
        left_s = self.estimation.broke_off(reason)
        self.warm.over("the estimator failed")
        self._note("error", f"ESTIMATOR FAILED: {reason}; it begins anew in {left_s:.0f} s")
        self.decisions.add(self.at_s, "ESTIMATOR FAILED")
        self._action_queue.add(self.writeback.on_estimator_failed(self._host_s))

    def _judged(self, found: EstimationResult) -> None:
        at_s, host_s, gates = found.when.at_s, found.when.host_s, found.gates
        if (estimate := found.estimate) is None:
            return
        self._out += [events.Estimated(at_s, host_s, estimate), events.Judged(at_s, host_s, gates)]
        self.decisions.judged(at_s, self.writeback.state.value, gates, estimate)
        if found.when.era != self._era():
            return  # it judged what is in force no more; nothing may be written by it
        if not self.warm.confirms(estimate):
            return  # it rests on an earlier run: nothing is written before this one agrees
        for_write, for_flash = self.settings.gates_of(gates)
        self._action_queue.add(
            self.writeback.on_verdict(
                estimate,
                for_write,
                at_s,
                self._host_s,
                gyro_is_raw=not self.stream.compensated_gyro,
                flash_gates=for_flash,
                sampled_s=host_s,
            )
        )

    def _era(self) -> tuple[int, int]:
        return self.source.epochs.now.number, self._breaks + self._judged_anew

    def _note(self, level: str, text: str) -> None:
        self._out.append(events.Noted(self.at_s, self._host_s, level, text))
