"""Samples of a run: strokes, forces and the energy balance, computed from the state."""

from __future__ import annotations

import math

from capture_sim.base.compiled.kernels import kernel
from capture_sim.dynamics.model.contact import elastic_contact_energy
from capture_sim.dynamics.model.equations import (
    AXIAL,
    FRICTION,
    HYSTERESIS,
    IMPULSE,
    LATCH,
    ROLLING,
    STOP,
    TORSION,
    axial_force,
    buffer_energy,
    gap_and_rate,
    hinge_torque,
    latch_energy,
    solve_accelerations,
    stop_energy,
    tip_forces,
    tip_in_cone,
)
from capture_sim.dynamics.model.trig import sine_cosine
from capture_sim.dynamics.samples import Phase
from capture_sim.scene.launch_motion import distance_at


@kernel
def kinetic_energy(y, par):
    """Return the kinetic energy of both vehicles and the buffer, J."""
    sS, cS = sine_cosine(y[2])
    sP, cP = sine_cosine(y[3])
    hinge_x = y[8] - par.a * y[10] * sS
    hinge_y = y[9] + par.a * y[10] * cS
    spin, rate = y[11], y[12]
    # first and second moments about the hinge carry cylinder and probe together
    r = y[4] - par.d
    moment = par.first_moment_0 + par.m_P * y[4]
    inertia = par.hinge_inertia_0 + par.m_P * r * r
    across = hinge_y * cP - hinge_x * sP
    along = hinge_x * cP + hinge_y * sP
    energy = par.m_S * (y[8] * y[8] + y[9] * y[9]) + par.I_S * y[10] * y[10]
    energy += (par.m_C + par.m_P) * (hinge_x * hinge_x + hinge_y * hinge_y)
    energy += inertia * spin * spin + 2.0 * moment * spin * across
    energy += par.m_P * (rate * rate + 2.0 * rate * along)
    energy += par.m_T * (y[13] * y[13] + y[14] * y[14]) + par.I_T * y[15] * y[15]
    return 0.5 * energy


@kernel
def floor_work(y, par):
    """Return the work of gravity along the floor, and of cables, since q = 0, J."""
    if not par.is_pulled:
        return 0.0
    cables = par.cable_S[0] * y[0] + par.cable_S[1] * y[1]
    cables += par.cable_T[0] * y[5] + par.cable_T[1] * y[6]
    sS, cS = sine_cosine(y[2])
    sP, cP = sine_cosine(y[3])
    beyond = (par.m_C + par.m_P) * par.a  # cylinder and probe at the hinge
    moment = par.first_moment_0 + par.m_P * y[4]
    x = par.m_total * y[0] + beyond * cS + moment * cP + par.m_T * y[5]
    y_ = par.m_total * y[1] + beyond * sS + moment * sP + par.m_T * y[6]
    return par.pull_x * x + par.pull_y * y_ + cables


@kernel
def mechanical_energy(y, system):
    """Return kinetic energy plus the energy stored in buffer, stops, contact and latch, J."""
    par, mode = system.par, system.mode
    stroke = y[4] - par.h_0
    axial, torsion = buffer_energy(stroke, y[3] - y[2], par)
    px, py, wx, wy = tip_in_cone(y, par)
    energy = kinetic_energy(y, par) + axial + torsion
    energy += stop_energy(stroke, mode.stop, par) + latch_energy(px, py, mode, par)
    for i in range(2):
        if mode.touch[i].on:
            gap, _, _, _ = gap_and_rate(px, py, wx, wy, 1.0 - 2.0 * i, par)
            energy += elastic_contact_energy(gap, par.contact)
    return energy


@kernel
def observe(t, y, w, sample):
    """Fill one record of dtype SAMPLE for the state ``y`` at the time ``t`` (s).

    ``w`` is a record of dtype :data:`capture_sim.dynamics.engine.state.WORKSPACE`.  The work of
    external wrenches is only that up to the start of the step; the caller adds the rest.
    """
    system, rail, totals = w.system, w.rail, w.totals
    par, mode, out = system.par, system.mode, system.out
    sample.t = t
    for i in range(8):
        sample.q[i] = y[i]
        sample.v[i] = y[8 + i]
    sample.at_rest = mode.rest_S + 2 * mode.rest_T
    sample.touches = totals.touches
    walls = mode.touch[0].on + 2 * mode.touch[1].on
    sample.walls = walls
    if rail.on:
        sample.phase = Phase.TAUT if rail.taut else Phase.COAST
    elif mode.latched:
        sample.phase = Phase.LATCHED
    else:
        sample.phase = Phase.CONTACT if walls else Phase.FREE

    stroke = y[4] - par.h_0
    torsion = y[3] - y[2]
    sample.axial_stroke = stroke
    sample.axial_force, _ = axial_force(stroke, y[12], mode.slide_direction, par)
    sample.torsion = torsion
    sample.torsion_torque, _ = hinge_torque(torsion, y[11] - y[10], par)

    px, py, wx, wy = tip_in_cone(y, par)
    sample.tip_axial = -(px + par.L_T)
    sample.tip_lateral = py
    sample.tip_distance = math.hypot(px + par.L_T, py)
    for i in range(2):
        out.normal[i] = 0.0
        out.friction_force[i] = 0.0
    if mode.held and rail.on:
        # on the rail the load of the buffer is neglected
        sample.axial_force = 0.0
    elif mode.held or mode.touch[0].sticking or mode.touch[1].sticking:
        # writes the friction forces that hold the tip, and the force that holds the probe
        solve_accelerations(y, system.spare[0], system)
        if mode.held:
            sample.axial_force = out.axial_force
    fx, fy, tip, _ = tip_forces(y, system, px, py, wx, wy)
    sT, cT = sine_cosine(y[7])
    gx = cT * fx - sT * fy
    gy = sT * fx + cT * fy
    contact = 0.0
    for i in range(2):
        gap, rate, _, _ = gap_and_rate(px, py, wx, wy, 1.0 - 2.0 * i, par)
        sample.penetration[i] = -gap
        sample.penetration_rate[i] = -rate
        sample.normal_force[i] = out.normal[i]
        sample.friction_force[i] = out.friction_force[i] if mode.touch[i].on else 0.0
        sample.impulse[i] = y[IMPULSE + i]
        if mode.touch[i].on:
            contact += elastic_contact_energy(gap, par.contact)
    sample.contact_force[0] = 0.0 if mode.latched else gx
    sample.contact_force[1] = 0.0 if mode.latched else gy
    sample.contact_torque = 0.0 if mode.latched else tip
    sample.latch_force[0] = gx if mode.latched else 0.0
    sample.latch_force[1] = gy if mode.latched else 0.0
    sample.elastic_contact = contact
    latch = latch_energy(px, py, mode, par)
    sample.elastic_latch = latch
    stop = stop_energy(stroke, mode.stop, par)
    sample.elastic_stop = stop

    kinetic = kinetic_energy(y, par)
    sample.string_tension = 0.0
    sample.mass_height = 0.0
    sample.mass_speed = 0.0
    if rail.taut:
        speed = y[8] * par.rail_x + y[9] * par.rail_y
        kinetic += 0.5 * (par.m_hanging + par.pulley_mass) * speed * speed
        travel = rail.travel + rail_travel(w, t)
        sample.mass_height = par.drop_height - travel
        sample.mass_speed = speed
        sinking = rail.acceleration - rail.damping * speed
        sample.string_tension = par.m_hanging * (par.gravity - sinking) - par.pulley_mass * sinking
    sample.kinetic = kinetic
    sample.elastic_axial, sample.elastic_torsion = buffer_energy(stroke, torsion, par)
    for i in range(6):
        sample.thrust[i] = 0.0 if rail.on else mode.thrust[i]
    sample.work_thrust = totals.work_thrust
    sample.work_string = par.m_hanging * par.gravity * (par.drop_height - sample.mass_height)
    sample.dissipated_axial = y[AXIAL]
    sample.dissipated_torsion = y[TORSION]
    sample.dissipated_contact = y[HYSTERESIS] + y[HYSTERESIS + 1]
    sample.dissipated_friction = y[FRICTION]
    # a constant force: its work in closed form
    slid = mode.slide_direction * (y[4] - totals.slide_from)
    sample.dissipated_slide = totals.lost_slide + par.slide_friction * slid
    sample.dissipated_rolling = y[ROLLING]
    sample.dissipated_latch = y[LATCH] + totals.lost_latch
    sample.dissipated_stop = y[STOP]
    sample.dissipated_landing = totals.lost_landing
    stored = kinetic + sample.elastic_axial + sample.elastic_torsion + contact + latch + stop
    lost = totals.lost_latch + totals.lost_landing + sample.dissipated_slide
    for i in range(AXIAL, STOP + 1):
        lost += y[i]
    sample.work_floor = floor_work(y, par) - totals.floor_0
    work = sample.work_string + totals.work_thrust + sample.work_floor
    sample.energy_residual = stored - totals.energy_0 - work + lost


@kernel
def rail_travel(w, t):
    """Return the chaser's travel along the rail within the present segment, m."""
    rail, tau = w.rail, t - w.step.t0
    return distance_at(rail.speed, rail.acceleration, rail.damping, tau)
