// The turnable view of report.html: one surface, three shapes, blended by the slider. Needs the global THREE.
(() => {
  'use strict';
  const byId = (id) => document.getElementById(id);
  const data = JSON.parse(byId('data').textContent);
  const bytes = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer;
  const floats = (text) => new Float32Array(bytes(text));
  const indices = (text) => new Uint32Array(bytes(text));
  const shapes = [floats(data.permanent), floats(data.median), floats(data.final)];
  const names = ['printed (permanent)', 'held (median)', 'unloaded (final)'];
  const box = byId('view');

  let renderer;
  try {
    renderer = new THREE.WebGLRenderer({ antialias: true, preserveDrawingBuffer: true });
  } catch (error) {
    byId('no-view').textContent += ' (' + error.message + ')';
    return;
  }
  byId('no-view').remove();
  box.appendChild(renderer.domElement);
  renderer.setPixelRatio(Math.min(window.devicePixelRatio, 2));
  const scene = new THREE.Scene();
  scene.background = new THREE.Color(0xfafafa);
  scene.add(new THREE.AmbientLight(0xffffff, 1.6));

  const position = new THREE.BufferAttribute(new Float32Array(shapes[0].length), 3);
  const surface = (index, attribute, options) => {
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute('position', attribute);
    geometry.setIndex(new THREE.BufferAttribute(index, 1));
    const material = new THREE.MeshLambertMaterial({ flatShading: true, side: THREE.DoubleSide, ...options });
    const mesh = new THREE.Mesh(geometry, material);
    mesh.frustumCulled = false;
    scene.add(mesh);
    return mesh;
  };
  // Faces of both materials lie in one plane where SMP reaches the surface: the offset keeps SMP in front there.
  const nearer = { polygonOffset: true, polygonOffsetFactor: -1, polygonOffsetUnits: -1 };
  surface(indices(data.smp), position, { color: 0x0096a5, ...nearer });
  surface(indices(data.clamp), position, { color: 0x96281e, ...nearer, polygonOffsetFactor: -2 });
  const tpe = surface(indices(data.outer), position, { color: 0xcfc9bd, transparent: true, depthWrite: false });
  const wanted = new THREE.BufferAttribute(floats(data.wanted), 3);
  const target = surface(indices(data.outer), wanted, { color: 0xe8a33d, transparent: true, opacity: 0.35, depthWrite: false });

  const low = new THREE.Vector3(Infinity, Infinity, Infinity), high = low.clone().negate();
  for (const shape of shapes) {
    for (let i = 0; i < shape.length; i += 3) {
      const p = new THREE.Vector3(shape[i], shape[i + 1], shape[i + 2]);
      low.min(p);
      high.max(p);
    }
  }
  const center = low.clone().add(high).multiplyScalar(0.5), size = high.distanceTo(low);

  const label = (text) => {
    const canvas = document.createElement('canvas');
    canvas.width = canvas.height = 64;
    const pen = canvas.getContext('2d');
    pen.fillStyle = '#fff';
    pen.strokeStyle = '#c81e1a';
    pen.lineWidth = 5;
    pen.beginPath();
    pen.arc(32, 32, 27, 0, 7);
    pen.fill();
    pen.stroke();
    pen.fillStyle = '#111';
    pen.font = 'bold 30px sans-serif';
    pen.textAlign = 'center';
    pen.textBaseline = 'middle';
    pen.fillText(text, 32, 34);
    const sprite = new THREE.Sprite(new THREE.SpriteMaterial({ map: new THREE.CanvasTexture(canvas), depthTest: false }));
    sprite.scale.setScalar(0.06 * size);
    return sprite;
  };
  // An arrow of length 1 along +y.
  const red = new THREE.MeshLambertMaterial({ color: 0xc81e1a });
  const shaft = new THREE.CylinderGeometry(0.03, 0.03, 0.7).translate(0, 0.35, 0);
  const head = new THREE.ConeGeometry(0.09, 0.3, 20).translate(0, 0.85, 0);
  const arrowAlong = (direction) => {
    const arrow = new THREE.Group();
    arrow.add(new THREE.Mesh(shaft, red), new THREE.Mesh(head, red));
    arrow.quaternion.setFromUnitVectors(new THREE.Vector3(0, 1, 0), direction);
    return arrow;
  };
  const forces = new THREE.Group();
  scene.add(forces);
  const largest = Math.max(1e-300, ...data.points.map((p) => p.size));
  const arrows = data.points.map((point, k) => {
    const along = new THREE.Vector3(...point.direction);
    const length = size * (0.06 + 0.12 * point.size / largest);
    const arrow = arrowAlong(along);
    const sprite = label(String(k + 1));
    forces.add(arrow, sprite);
    return { arrow, sprite, point, along, length };
  });

  const camera = new THREE.PerspectiveCamera(35, 1, size / 100, size * 20);
  camera.up.set(0, 0, 1);
  camera.position.copy(center).add(new THREE.Vector3(0.57, -1.02, 0.49).multiplyScalar(size));
  const sun = new THREE.DirectionalLight(0xffffff, 1.9);
  sun.position.set(0.4, 0.6, 1);
  camera.add(sun);
  scene.add(camera);
  const controls = new THREE.TrackballControls(camera, renderer.domElement);
  controls.target.copy(center);
  controls.rotateSpeed = 3;
  controls.staticMoving = true;

  const place = (s) => {
    const from = shapes[Math.min(1, Math.floor(s))], to = shapes[Math.min(1, Math.floor(s)) + 1];
    const w = s - Math.min(1, Math.floor(s));
    for (let i = 0; i < from.length; i++) position.array[i] = (1 - w) * from[i] + w * to[i];
    position.needsUpdate = true;
    for (const { arrow, sprite, point, along, length } of arrows) {
      const v = 3 * point.vertex;
      const foot = new THREE.Vector3(position.array[v], position.array[v + 1], position.array[v + 2]);
      const load = Math.min(1, Math.max(s, 0.05));
      arrow.position.copy(foot);
      arrow.scale.setScalar(length * load);
      sprite.position.copy(foot).addScaledVector(along, length * load + 0.04 * size);
    }
  };
  const draw = () => renderer.render(scene, camera);
  const update = () => {
    const s = Number(byId('stage').value);
    place(s);
    tpe.material.opacity = Number(byId('tpe').value);
    tpe.visible = tpe.material.opacity > 0;
    target.visible = byId('target').checked;
    forces.visible = byId('arrows').checked && s <= 1.005;
    const at = Math.abs(s - Math.round(s)) < 0.005;
    byId('stage-name').textContent = at ? names[Math.round(s)] : s < 1 ? 'loading, hot' : 'unloading, cold';
    draw();
  };
  const resize = () => {
    renderer.setSize(box.clientWidth, box.clientHeight);
    camera.aspect = box.clientWidth / box.clientHeight;
    camera.updateProjectionMatrix();
    controls.handleResize();
    draw();
  };
  for (const id of ['stage', 'tpe', 'arrows', 'target']) byId(id).addEventListener('input', update);
  controls.addEventListener('change', draw);
  window.addEventListener('resize', resize);
  const turn = () => { controls.update(); requestAnimationFrame(turn); };
  resize();
  update();
  turn();
})();
