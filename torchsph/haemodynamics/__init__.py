"""What people read out of a flow: vorticity, energy, forces, flow rates, vortices, pressure, transit of blood."""
