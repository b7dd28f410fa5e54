"""Planning: from goals, a pose and the occupancy grid to a path.

Exports: `navigator.Navigator` (goal queue and replanning), `planner` (one path query, answered over several
steps) and its search `astar`, `costmap` with `PlannerSettings`, `snapshot` of it, `polyline.Polyline`.
Must not import: perception (the map is described by the protocol `costmap.Map`), control.
"""
