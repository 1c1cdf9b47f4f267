"""Bodies: ropes, cloths, garments and triangle meshes as particles and springs, in SI units."""

from jaxsimp.bodies.body import Body
from jaxsimp.bodies.constructors import cloth, from_mesh, rope, rope_along
from jaxsimp.bodies.garments import Garment, skirt, t_shirt, towel, trousers
from jaxsimp.bodies.material import MATERIALS, Material
from jaxsimp.bodies.mesh_files import load_mesh, read_mesh
from jaxsimp.bodies.meshes import clean_mesh
from jaxsimp.bodies.outlines import mesh_outline, mesh_symmetric_outline
from jaxsimp.bodies.remeshing import remesh

__all__ = [
    "MATERIALS",
    "Body",
    "Garment",
    "Material",
    "clean_mesh",
    "cloth",
    "from_mesh",
    "load_mesh",
    "mesh_outline",
    "mesh_symmetric_outline",
    "read_mesh",
    "remesh",
    "rope",
    "rope_along",
    "skirt",
    "t_shirt",
    "towel",
    "trousers",
]
