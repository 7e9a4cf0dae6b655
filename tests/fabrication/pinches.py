"""Pinched vertices, asked of the triangles one by one."""

from collections import Counter, defaultdict

from fab4d.mesh.topology import TET_FACES


def pinched_by_hand(tets, smp):
    """The same question asked of the triangles one by one, in Python sets."""
    pinched = set()
    for label in (True, False):
        faces = Counter(tuple(sorted(face)) for tet in tets[smp == label] for face in tet[TET_FACES].tolist())
        links = defaultdict(list)
        for face in (f for f, count in faces.items() if count == 1):
            for v in face:
                links[v].append([w for w in face if w != v])
        pinched |= {v for v, edges in links.items() if not is_one_cycle(edges)}
    return sorted(pinched)


def is_one_cycle(edges):
    neighbours = defaultdict(set)
    for a, b in edges:
        neighbours[a].add(b)
        neighbours[b].add(a)
    if any(len(n) != 2 for n in neighbours.values()):
        return False
    seen, waiting = set(), [edges[0][0]]
    while waiting:
        node = waiting.pop()
        if node not in seen:
            seen.add(node)
            waiting += neighbours[node]
    return len(seen) == len(neighbours)
