"""Warp's kernels of draping: what one station and one step do to cloth. Their arrays lie on the CPU.

A kernel that takes steps goes through the constraints one after another, in a fixed order: Gauss-Seidel without colours
or atomics. All are compiled for any CPU, without fused multiply-adds, so that the bytes are the same on all of them.
"""

from datagen.common.quiet_warp import wp

wp.set_module_options({"enable_backward": False, "fuse_fp": False, "fast_math": False, "cpu_compiler_flags": ""})

STEP = wp.constant(1 / 240)
"""Seconds of a step."""
_KEPT = wp.constant(0.98)  # of the velocity at each step
_FASTEST = wp.constant(3.0)  # metres a second
_FRICTION = wp.constant(0.2)
_PASSES = wp.constant(4)  # over the edges, each step
_GAP = wp.constant(0.003)  # metres between parts


@wp.struct
class State:
    """Vertices of cloth: place, place a step ago, velocity, 1 / mass (area), and planes that each stays outside of.

    It keeps ``distance`` from the body's (``contact``, ``normal``), and ``_GAP`` from that of the parts below
    (``under``, ``under_normal``); a normal is zero where there is nothing near. It is at most ``tether`` from ``pin``.
    """

    place: wp.array(dtype=wp.vec3)
    before: wp.array(dtype=wp.vec3)
    velocity: wp.array(dtype=wp.vec3)
    inverse_mass: wp.array(dtype=wp.float32)
    distance: wp.array(dtype=wp.float32)
    contact: wp.array(dtype=wp.vec3)
    normal: wp.array(dtype=wp.vec3)
    under: wp.array(dtype=wp.vec3)
    under_normal: wp.array(dtype=wp.vec3)
    tether: wp.array(dtype=wp.float32)
    pin: wp.array(dtype=wp.int32)


@wp.struct
class Springs:
    """Pairs of vertices that keep their distance at rest: ends, length, and compliance over step^2."""

    ends: wp.array(dtype=wp.vec2i)
    length: wp.array(dtype=wp.float32)
    compliance: wp.array(dtype=wp.float32)


@wp.struct
class Skin:
    """Skinning of cloth: places at rest; bones and weights of each vertex, from ``first[vertex]`` on."""

    rest: wp.array(dtype=wp.vec3)
    first: wp.array(dtype=wp.int32)
    bone: wp.array(dtype=wp.int32)
    weight: wp.array(dtype=wp.float32)


@wp.struct
class Pins:
    """Vertices that hang on the body: the triangle below, the place in its plane, metres above it."""

    vertex: wp.array(dtype=wp.int32)
    corners: wp.array(dtype=wp.vec3i)
    barycentric: wp.array(dtype=wp.vec3)
    above: wp.array(dtype=wp.float32)


@wp.kernel
def advect(
    skin: Skin,
    turn: wp.array(dtype=wp.mat33),
    shift: wp.array(dtype=wp.vec3),
    next_turn: wp.array(dtype=wp.mat33),
    next_shift: wp.array(dtype=wp.vec3),
    state: State,
):
    """Carry cloth from one station to the next as the skin would go; what is off the skin turns along."""
    vertex = wp.tid()
    rest = skin.rest[vertex]
    here = wp.vec3(0.0, 0.0, 0.0)
    there = wp.vec3(0.0, 0.0, 0.0)
    turned = wp.mat33(0.0)
    for entry in range(skin.first[vertex], skin.first[vertex + 1]):
        bone = skin.bone[entry]
        weight = skin.weight[entry]
        here += weight * (turn[bone] * rest + shift[bone])
        there += weight * (next_turn[bone] * rest + next_shift[bone])
        turned += weight * (next_turn[bone] * wp.transpose(turn[bone]))
    state.place[vertex] = there + turned * (state.place[vertex] - here)
    state.velocity[vertex] = turned * state.velocity[vertex]


@wp.kernel
def hang(pins: Pins, body: wp.array(dtype=wp.vec3), state: State):
    """Put pinned vertices where the body has them."""
    pin = wp.tid()
    corners = pins.corners[pin]
    share = pins.barycentric[pin]
    a = body[corners[0]]
    b = body[corners[1]]
    c = body[corners[2]]
    normal = wp.normalize(wp.cross(b - a, c - a))
    state.place[pins.vertex[pin]] = share[0] * a + share[1] * b + share[2] * c + pins.above[pin] * normal


@wp.kernel
def touch(body: wp.uint64, reach: wp.float32, state: State):
    """Find the plane of the body that each vertex has to stay outside of; a zero normal where there is none near."""
    vertex = wp.tid()
    place = state.place[vertex]
    state.normal[vertex] = wp.vec3(0.0, 0.0, 0.0)
    found = wp.mesh_query_point_sign_normal(body, place, reach)
    if found.result:
        nearest = wp.mesh_eval_position(body, found.face, found.u, found.v)
        away = place - nearest
        far = wp.length(away)
        normal = wp.mesh_eval_face_normal(body, found.face)
        if far > 1.0e-4:
            normal = away * (found.sign / far)
        state.contact[vertex] = nearest
        state.normal[vertex] = normal


@wp.kernel
def touch_part(below: wp.uint64, first: int, reach: float, state: State):
    """The same for the parts below, of which only the outer side is kept to: away from the body, where it is near.

    Normals of the cloth itself are those of its folds: a bunched hem would carry what lies over it upwards.
    """
    vertex = first + wp.tid()
    state.under_normal[vertex] = wp.vec3(0.0, 0.0, 0.0)
    found = wp.mesh_query_point_no_sign(below, state.place[vertex], reach)
    if found.result:
        normal = wp.mesh_eval_face_normal(below, found.face)
        if wp.length_sq(state.normal[vertex]) > 0.5:
            normal = state.normal[vertex]
        state.under[vertex] = wp.mesh_eval_position(below, found.face, found.u, found.v)
        state.under_normal[vertex] = normal


@wp.func
def _project(springs: Springs, state: State):
    for spring in range(springs.ends.shape[0]):
        one = springs.ends[spring][0]
        other = springs.ends[spring][1]
        apart = state.place[one] - state.place[other]
        length = wp.length(apart)
        excess = length - springs.length[spring]
        summed = state.inverse_mass[one] + state.inverse_mass[other] + springs.compliance[spring]
        if length > 1.0e-9 and summed > 0.0:
            move = apart * (excess / (summed * length))
            state.place[one] = state.place[one] - state.inverse_mass[one] * move
            state.place[other] = state.place[other] + state.inverse_mass[other] * move


@wp.func
def _hold(state: State):
    """Bring vertices that are further from their pin than cloth reaches back to where it does."""
    for vertex in range(state.place.shape[0]):
        pin = state.place[state.pin[vertex]]
        apart = state.place[vertex] - pin
        length = wp.length(apart)
        if length > state.tether[vertex] and state.inverse_mass[vertex] > 0.0:
            state.place[vertex] = pin + apart * (state.tether[vertex] / length)


@wp.func
def _kept_off(place: wp.vec3, before: wp.vec3, plane: wp.vec3, normal: wp.vec3, distance: float, friction: float):
    """The place outside of a plane; what it moved along the plane in this step is less by friction times its depth."""
    depth = distance - wp.dot(place - plane, normal)
    outside = place
    if depth > 0.0 and wp.length_sq(normal) > 0.5:
        outside = place + depth * normal
        moved = outside - before
        along = moved - normal * wp.dot(moved, normal)
        far = wp.length(along)
        if far > 1.0e-9:
            outside = outside - along * wp.min(1.0, friction * depth / far)
    return outside


@wp.kernel
def take_steps(
    count: int,
    gravity: float,
    edges: Springs,
    bends: Springs,
    state: State,
):
    """So many steps of one cloth, in one thread."""
    fall = wp.vec3(0.0, -gravity * STEP, 0.0)
    for _ in range(count):
        for vertex in range(state.place.shape[0]):
            state.before[vertex] = state.place[vertex]
            if state.inverse_mass[vertex] > 0.0:
                state.velocity[vertex] = _KEPT * state.velocity[vertex] + fall
                state.place[vertex] = state.place[vertex] + STEP * state.velocity[vertex]
        _project(bends, state)
        for _pass in range(_PASSES):  # last, so that cloth that bends stiffly is not stretched by it
            _project(edges, state)
        _hold(state)
        for vertex in range(state.place.shape[0]):
            place = state.place[vertex]
            before = state.before[vertex]
            if state.inverse_mass[vertex] > 0.0:
                place = _kept_off(place, before, state.under[vertex], state.under_normal[vertex], _GAP, _FRICTION)
                distance = state.distance[vertex]
                place = _kept_off(place, before, state.contact[vertex], state.normal[vertex], distance, _FRICTION)
                state.place[vertex] = place
            velocity = (place - before) / STEP
            speed = wp.length(velocity)
            if speed > _FASTEST:
                velocity = velocity * (_FASTEST / speed)
            state.velocity[vertex] = velocity
