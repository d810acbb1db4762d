"""The pure core: inputs in, events out. `run` and `replay` feed it the same way.

It connects the parts and decides nothing itself: `device_session` communicates with the device,
`sample_source` produces samples, `estimation` estimates and judges, the write-back decides what may
be written, and `write_back` carries that out. The core's time is that of the inputs. Its output
depends on the list of inputs alone, so a replay takes the same decisions; `decisions` holds them
and their hash.
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
        # the device and its samples
        self.source: SampleSource[Circumstances] = SampleSource(settings)
        self.stream = self.source.stream
        self.device_session = DeviceSession(
            settings.policy.mode,
            change_stream=settings.policy.configure_stream,
            rate_hz=settings.output_rate_hz,
            reply_timeout_s=settings.reply_timeout_s,
        )
        # the estimate
        self.estimation = Estimation(settings.calibrator, self._begin_task)
        self.warm = WarmStart(settings.warm_start_s, passive=passive)
        # the write-back
        self.writeback = WriteBack(settings.policy)
        self._action_queue = ActionQueue(self.device_session, self.writeback, self.stream.forgive)
        self._device_record = DeviceRecord()
        self._trial = TrialComparison(self.writeback)
        self._answers = OperatorAnswers()
        self.clients = Clients(settings.shares, self.device_session, self.writeback)
        self.at_s = self._host_s = 0.0
        self.first_s = float("nan")
        self.faults = self._breaks = 0
        self._stopping, self._limit_changes = "", 0
        self._closing = self._needs_restart = False
        self._out: list[events.Event] = []
        if passive:
            self._proceed_without_device()
        device, back, add = self.device_session, self.writeback, self._action_queue.add
        self._handlers: dict[type, Callable[..., None]] = {
            inputs.Received: lambda it: self.process_events(device.receive(it.data, self._host_s)),
            inputs.Tick: lambda _: self.process_events(device.tick(self._host_s)),
            inputs.WallClock: self._on_wall_clock,
            inputs.LinkOpened: self._on_link_opened,
            inputs.LinkLost: self._on_link_lost,
            inputs.Interlock: lambda it: add(back.on_interlock(it.safe, self._host_s)),
            inputs.Operator: self._on_operator,
            inputs.ClientSent: lambda it: self.clients.on_bytes(it, self._host_s),
            inputs.ClientLeft: self.clients.on_disconnected,
            **dict.fromkeys((inputs.Columns, inputs.TermsKnown), self.source.vehicle.take),
            inputs.RegistersKnown: self._on_registers_known,
            inputs.Samples: self._on_samples,
            inputs.EarlierSamples: self.warm.add_samples,
            inputs.EarlierRun: lambda it: self._note_warm_start(self.warm.on_samples_complete(it)),
            inputs.JournalOpened: self._on_journal_opened,
            inputs.Journalled: self._on_journalled,
            inputs.Examined: lambda it: self._take_results(it.pieces, it.failure),
            inputs.LimitsChanged: self._on_limits_changed,
            inputs.Stop: self._on_stop,
        }

    # -- the two calls of a shell ------------------------------------------------------------------

    def handle(self, item: inputs.Input) -> list[events.Event]:
        """Take one input; returns all resulting events, in order."""
        self._host_s = max(self._host_s, item.host_ns * 1e-9)
        self._action_queue.emit_leading_events(self)
        # first: whether a command may be sent depends on the age of the interlock signal *now*
        self._action_queue.add(self.writeback.tick(self._host_s))
        self._handlers[type(item)](item)
        self._run_until_idle()
        if not self._action_queue.awaiting_journal:
            self._out += self._answers.take()
        out, self._out = self._out, []
        return out

    @property
    def deadline_ns(self) -> int | None:
        """When a `Tick` is needed if no other input arrives before, on the host's clock."""
        parts = (self.device_session, self.writeback, self.clients)
        due = [part.deadline_s for part in parts]
        known = [d for d in due if d is not None]
        return int(min(known) * 1e9) + 1 if known else None

    # -- read by others ----------------------------------------------------------------------------

    @property
    def registers(self) -> dict[int, Values]:
        """The known registers of the device."""
        return self.source.registers

    @property
    def calibrator(self) -> Calibrator:
        """The calibrator in use."""
        return self.estimation.calibrator

    @calibrator.setter
    def calibrator(self, calibrator: Calibrator) -> None:
        self.estimation.calibrator = calibrator

    # -- inputs ------------------------------------------------------------------------------------

    def _on_wall_clock(self, item: inputs.WallClock) -> None:
        add, back = self._action_queue.add, self.writeback
        self.warm.set_clock(item)
        add(back.on_clock(item.wall_s, item.boot_id, item.boot_s, self._host_s))

    def _on_link_opened(self, item: inputs.LinkOpened) -> None:
        latency = "" if item.latency_ms is None else f", USB latency {item.latency_ms} ms"
        self._note("info", f"{item.port} open at {item.baud} baud{latency}")
        self.stream.forget()
        if self.device_session.mode is Mode.PASSIVE:
            self._proceed_without_device()
        else:
            self.source.epochs.begin_anew()  # no decompensation before the registers are known
        self.process_events(self.device_session.on_opened(item.baud, self._host_s))

    def _on_link_lost(self, item: inputs.LinkLost) -> None:
        self._flush()
        self._breaks += 1
        self._note("warning", f"link lost: {item.reason}")
        self.process_events(self.device_session.on_link_lost(self._host_s))
        self.stream.forget()
        self.source.unconfirmed.drop()
        self._action_queue.forget_procedure()
        self._action_queue.add(self.writeback.on_link_lost(self._host_s))

    def _on_operator(self, item: inputs.Operator) -> None:
        self._note("info", f"operator: {item.verb} {item.argument}".strip())
        back = self.writeback
        self._action_queue.add(back.on_operator(item.verb, item.argument, self._host_s))
        self._answers.add(item.word, back.operator_answer)

    def _on_journalled(self, item: inputs.Journalled) -> None:
        self._action_queue.on_journalled(item, self._host_s)
        self._answers.on_journalled(item)

    def _on_registers_known(self, item: inputs.RegistersKnown) -> None:
        self._flush()
        self._note("info", f"registers taken from {item.source}")
        self._apply_registers(dict(item.values))
        self._proceed_without_device()

    def _on_samples(self, item: inputs.Samples) -> None:
        self.stream.given(item.block)
        self._process_block(item.block)

    def _on_journal_opened(self, item: inputs.JournalOpened) -> None:
        if error := self._device_record.on_journal_read(item):
            self._note("error", f"journal: {error}; nothing can be written")
        self._report_device()

    def _on_limits_changed(self, item: inputs.LimitsChanged) -> None:
        self._limit_changes += 1
        self._note("info", "the limits of the gates were changed")
        calibrator = self.estimation.set_limits(item.limits)
        self.settings = replace(self.settings, calibrator=calibrator)
        self._action_queue.add(self.writeback.on_limits_changed(self._host_s))

    def _on_stop(self, item: inputs.Stop) -> None:
        self._flush()
        self._stopping = item.reason
        self._action_queue.stop(self._host_s)

    # -- the device --------------------------------------------------------------------------------

    def process_events(self, found: list[SessionEvent]) -> None:
        """Turn measurements into samples; handle doubts, faults and a restart of the device."""
        skipped = self.device_session.session.deframer.take_skipped()
        for item in self.source.take(found, skipped, self._host_s):
            match item:
                case SampleBlock():
                    self._process_block(item)
                case Doubt(reason):
                    self._raise_doubt(reason)
                case SampleWarning(text):
                    self._note("warning", text)
                case DeviceFault(code):
                    self._on_device_fault(code)
        if self.source.take_restart():
            newest_s = self.stream.newest_s  # unknown device: no proof of a restart
            started_s = self._host_s - (self.at_s if newest_s is None else newest_s)
            client = self.clients.reset_by(started_s)
            if client:
                self.stream.excuse_restart()
            self._on_device_reset("its time fell", self.at_s, client)

    def _raise_doubt(self, reason: str, *, jumped: bool = False) -> None:
        """From now on samples may be of another device, for this reason; empty: no doubt."""
        if reason and self.device_session.listening and self.device_session.identity is not None:
            self.warm.restart_confirmation()
            if not jumped:
                restarted = not self.stream.carries_time  # else its time would have fallen
                self.source.unconfirmed.mark_doubt(self._host_s, perhaps_restarted=restarted)
            more = self.writeback.on_doubt(reason, self._host_s, jumped=jumped)
            self._action_queue.add(more)
            if jumped:
                self._trial.restart(self.registers)

    def _on_device_fault(self, code: int) -> None:
        self.faults += 1
        self._note("warning", f"the device reports VNERR {code:02X}")
        self.clients.broadcast_fault(code)
        if code in (_WATCHDOG_RESET, _HARD_FAULT):
            self._on_device_reset(f"VNERR {code:02X}")

    def _on_device_reset(self, why: str, uptime_s: float | None = None, client: str = "") -> None:
        self._note("warning", f"the device restarted ({why})")
        self._breaks += 1
        self.source.unconfirmed.drop()
        if self.device_session.identity is None:
            return
        if client:  # the vehicle turned meanwhile: a change of the readings is no jump
            self.source.on_output_resumed(self._host_s)
        self.source.mark_registers_unknown(self._host_s)
        self._action_queue.add(self.writeback.on_reset(self._host_s, uptime_s, client))
        self._action_queue.forget_procedure()
        self.process_events(self.device_session.identify_again(self._host_s))

    def _proceed_without_device(self) -> None:
        """Passive mode, or a recording without commands: take the stream as it is."""
        self._action_queue.add(self.writeback.on_no_device(self.registers or None, self._host_s))

    def _report_device(self) -> None:
        """Report the device to the write-back once identity, registers and journal are known."""
        self._action_queue.add(
            self._device_record.report(self.device_session, self.writeback, self._host_s)
        )

    def _apply_registers(self, values: dict[int, Values]) -> None:
        """The device applies these registers from now on; the first ones centre the prior."""
        self.source.set_registers(values, self._host_s)
        # during a trial, a candidate is still compared with the user's registers before it
        trial = self.writeback.history.open
        self.estimation.compare_with(values if trial is None else {**values, **trial.old})

    def _on_identified(self, event: Identified) -> None:
        """A device was identified: if it is another one, discard the estimate of the former."""
        unit = event.identity.unit
        self._note("info", str(unit))
        if (before := self._device_record.on_identified(unit)) not in (None, unit):
            self._flush()
            self.source.on_output_paused(self._host_s)
            text = f"{before} was here before: the calibration begins anew for this one"
            self._note("warning", f"another device, {unit}; {text}")
            self.estimation.restart_from_identity()
            self.warm.end("another device was here")
        self._out.append(events.OpenJournal(unit.serial))

    def _on_device_event(self, event: DeviceEvent) -> None:
        match event:
            case Identified():
                self._on_identified(event)
            case ConfigurationRead(values):
                self._flush()
                self.source.unconfirmed.drop()  # it was read because of a doubt
                believed = {} if self.writeback.history.open else self.registers
                if others := self._device_record.on_registers_read(values, believed, self._breaks):
                    self._note("warning", f"somebody changed registers {others}: calibrated anew")
                if self._needs_restart or others:  # never mix raw and decompensated samples
                    self.estimation.restart_from_identity()
                    self._needs_restart = False
                    self.warm.end("calibrated anew")
                self._apply_registers(values)
                self._out.append(events.RegistersRead(self._host_s, values))
                self._report_device()
            case Looked(seen, error):
                back = self.writeback
                self._action_queue.add(back.on_looked(seen, str(error or ""), self._host_s))
                if back.confirmed_s is not None:
                    for blocks, when in self.source.unconfirmed.confirm(back.confirmed_s):
                        self._examine(blocks, when)
            case Served(result, error):
                self._on_client_served(result, error)
            case StreamChanged(text, level):
                self._flush()
                self.source.on_output_paused(self._host_s)
                if text:
                    self._note(level, text)
            case Unanswered(text):
                self._needs_restart = True
                self._note("warning", f"{text}; listening only, nothing can be written")
                self.source.accept_undecompensated(self._host_s)
                self._proceed_without_device()
            case Completed(name, result, error):
                self._flush()
                self.source.on_output_paused(self._host_s)
                if error is None:
                    more = self.writeback.on_procedure_finished(name, result, self._host_s)
                else:
                    more = self.writeback.on_procedure_failed(name, error, self._host_s)
                self._action_queue.add(more)
            case Closed(error):
                if error is not None:
                    self._note("error", f"not everything was put back: {error}")
                self._out.append(events.Finished(self._stopping))

    # -- actions of the write-back -----------------------------------------------------------------

    def _run_until_idle(self) -> None:
        """Exchange events and actions of device session and write-back until none is left."""
        while True:
            found = self.device_session.take_events()
            for event in found:
                self._on_device_event(event)
            acted = self._action_queue.run_actions(self, self._host_s)
            acted |= self._serve_clients()
            if self._stopping and not self._closing and self._action_queue.may_close:
                self._closing = acted = True
                self.process_events(self.device_session.restore_and_close(self._host_s))
            if not found and not acted:
                break
        if output := self.device_session.session.take_output():
            self._out.append(events.Send(output))
        for text in self.clients.take_notes():
            self._note("warning", text)
        self._out += self.clients.take_answers()

    def _serve_clients(self) -> bool:
        """Send a client's command if the wire is free; returns whether anything was done."""
        free = not (self._action_queue.procedure_waiting or self._stopping)
        actions, turn = self.clients.next_turn(self._host_s, free=free)
        self._action_queue.add(actions)
        if turn is not None:
            asked = turn.asked
            self.process_events(
                self.device_session.serve(asked.command, self._host_s, asked.purpose, turn.known)
            )
        return bool(actions) or turn is not None

    def _on_client_served(self, result: object, error: Exception | None) -> None:
        """A client's command ended: apply what it changed in the device."""
        served = self.clients.on_served(result, error, self.registers, self._host_s)
        if served.wrote:
            self._flush()
            self.source.add_client_write(served.wrote)
            self.source.on_output_paused(self._host_s)
        self._action_queue.add(served.actions)
        if served.reset_by:
            self._on_device_reset(f"{served.reset_by} reset it", client=served.reset_by)

    def emit(self, event: events.Event) -> None:
        """Take an event of the write-back."""
        self._out.append(event)
        if isinstance(event, events.StateChanged):
            self._on_state_changed(event)

    def set_registers_in_force(self, registers: Mapping[int, Values] | None) -> None:
        """The device applies these registers from now on; None: unknown during a write."""
        self._flush()
        if registers is None:
            self.source.mark_registers_unknown(self._host_s)
        else:
            self._apply_registers(dict(registers))

    def calibrate_anew(self, reason: str) -> None:
        """The registers used for decompensation have not been in force for an unknown time."""
        self._flush()
        self._needs_restart = True  # from scratch as soon as they are read
        self._breaks += 1
        self._note("warning", f"calibrated anew: {reason}")

    def _on_state_changed(self, change: events.StateChanged) -> None:
        self.decisions.add(self.at_s, change.new, reason=change.reason)
        self._trial.on_state_changed(change, self.registers)

    # -- samples -----------------------------------------------------------------------------------

    def _flush(self) -> None:
        for block in self.stream.flush():
            self._process_block(block)

    def _process_block(self, block: SampleBlock) -> None:
        self.at_s = float(block.time_s[-1])
        self.first_s = float(block.time_s[0]) if np.isnan(self.first_s) else self.first_s
        if self.source.has_uptime:
            heard_s = min(float(block.host_s[-1]), self._host_s)
            self._action_queue.add(self.writeback.on_uptime(self.at_s, self._host_s, heard_s))
        if self.stream.take_replaced():
            self.source.unconfirmed.drop()
            self.estimation.restart()
            self.warm.reuse()
        if self.clients.resetting:  # its reply may have come with these readings
            self.source.on_output_resumed(self._host_s)
        reason, jumped = self.source.find_suspicion(block)
        self._raise_doubt(reason, jumped=jumped)
        block, present = self.source.vehicle.with_columns(block), self.source.present_correction
        self._out.append(events.SamplesSeen(block, present, self.estimation.proposed))
        self._action_queue.add(self.writeback.on_samples(block))
        for text in self.source.sensors.take(block):
            self._note("warning", text)
        if (free := self.source.vehicle.without_terms(block)) is not None:
            self._action_queue.add(self._trial.take(free, self._host_s))
            self._hold_or_examine(free)
        self._action_queue.emit_leading_events(self)

    def _hold_or_examine(self, block: SampleBlock) -> None:
        """Examine the block at once, or hold it until the device has been confirmed after it."""
        now = self._circumstances(self._host_s or self.at_s)
        if self.device_session.identity is None or self.device_session.mode is Mode.PASSIVE:
            self._examine([block], now)  # no device can be asked
            return
        waiting = self.source.unconfirmed
        waiting.hold(block, self._host_s, now)
        self._action_queue.add(self.writeback.on_waiting(waiting.span_s, self._host_s))

    def _circumstances(self, host_s: float) -> Circumstances:
        basis = self.source.basis(self.device_session.identity)
        margin, era = self.writeback.margin, self._era()
        return Circumstances(self.at_s, host_s, self.stream.health(), basis, margin, era)

    def _examine(self, blocks: list[SampleBlock], when: Circumstances) -> None:
        """Give samples of the confirmed device to the calibrator."""
        if taken := [block for block in blocks if self.estimation.state.accepts(block)]:
            taken[0] = self._add_earlier_run(taken[0])
            for block in taken:
                self.warm.add_live_samples(block)
            self.estimation.examine(taken, when)

    def _add_earlier_run(self, block: SampleBlock) -> SampleBlock:
        """Give the calibrator the samples of an earlier run, if any are due; returns the block."""
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
        blocks, text = self.warm.take_due(present, float(block.time_s[0]))
        self._note_warm_start(text)
        if not blocks:
            return block
        ours = [replace(old, epoch=epoch.number) for old in blocks]
        self.estimation.restart_with_earlier(ours, self._circumstances(self._host_s))
        self._action_queue.add(self.writeback.on_doubt("samples of an earlier run", self._host_s))
        unknown = np.concatenate([[np.nan], block.dt_s[1:]])
        return replace(block, dt_s=unknown, gap_before=True)

    def _note_warm_start(self, text: str) -> None:
        if text:
            self._note("info", text)

    def _begin_task(self, task: EstimationTask) -> None:
        """Hand the task to the estimation thread, or do it now."""
        if self.settings.beside:
            self._out.append(events.Examine(task.work))
        else:
            self._take_results(1)

    def _take_results(self, tasks: int, failure: str = "") -> None:
        for found in self.estimation.take_results(tasks, failure):
            if isinstance(found, EstimationFailure):
                self._on_estimator_failed(found.reason)
                continue
            self._out += found.notes
            back, when = self.writeback, found.when
            if found.void:
                self.warm.restart_confirmation()
                self._action_queue.add(back.on_void(found.void, when.at_s, self._host_s))
            self._report_verdict(found)
            self._action_queue.add(back.on_examined(when.host_s, self._host_s))

    def _on_estimator_failed(self, reason: str) -> None:
        """Drop the calibrator and what it proposed; a new one starts after a pause."""
        pause_s = self.estimation.record_failure(reason)
        self.warm.end("the estimator failed")
        self._note("error", f"ESTIMATOR FAILED: {reason}; it begins anew in {pause_s:.0f} s")
        self.decisions.add(self.at_s, "ESTIMATOR FAILED")
        self._action_queue.add(self.writeback.on_estimator_failed(self._host_s))

    def _report_verdict(self, found: EstimationResult) -> None:
        at_s, host_s, gates = found.when.at_s, found.when.host_s, found.gates
        if (estimate := found.estimate) is None:
            return
        self._out += [events.Estimated(at_s, host_s, estimate), events.Judged(at_s, host_s, gates)]
        self.decisions.add_verdict(at_s, self.writeback.state.value, gates, estimate)
        if found.when.era != self._era():
            return  # the registers or link it judged are no longer current: it may not write
        if not self.warm.confirms(estimate):
            return  # it rests on an earlier run: no write before this run agrees
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
        return self.source.epochs.now.number, self._breaks + self._limit_changes

    def _note(self, level: str, text: str) -> None:
        self._out.append(events.Noted(self.at_s, self._host_s, level, text))
