"""Warp's kernels of :mod:`training.avatar.solid`, compiled for any CPU."""

from datagen.common.quiet_warp import wp

wp.set_module_options({"enable_backward": False, "fuse_fp": False, "fast_math": False, "cpu_compiler_flags": ""})
_FAR = wp.constant(1e6)


@wp.kernel
def depth(mesh: wp.uint64, points: wp.array(dtype=wp.vec3), found: wp.array(dtype=wp.float32)):
    """How deep each point lies inside, negative outside."""
    row = wp.tid()
    query = wp.mesh_query_point_sign_winding_number(mesh, points[row], _FAR, 2.0, 0.5)
    closest = wp.mesh_eval_position(mesh, query.face, query.u, query.v)
    found[row] = -query.sign * wp.length(points[row] - closest)


@wp.kernel
def seen(
    mesh: wp.uint64,
    points: wp.array(dtype=wp.vec3),
    normals: wp.array(dtype=wp.vec3),
    rays: wp.array(dtype=wp.vec3),
    lift: wp.float32,
    found: wp.array(dtype=wp.int32),
):
    """Whether a ray from each point to the outer side meets nothing."""
    row = wp.tid()
    start = points[row] + lift * normals[row]
    found[row] = 0
    for number in range(rays.shape[0]):
        ray = rays[number]
        if wp.dot(ray, normals[row]) > 0.1 and found[row] == 0:
            query = wp.mesh_query_ray(mesh, start, ray, _FAR)
            if not query.result:
                found[row] = 1
