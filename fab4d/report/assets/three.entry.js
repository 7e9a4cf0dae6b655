// What report.html uses of three.js. three.min.js is made from this file, in a folder where both packages are installed:
//   npm install three@0.187.0 esbuild@0.28.2
//   npx esbuild three.entry.js --bundle --minify --format=iife --global-name=THREE --legal-comments=inline --outfile=three.min.js
export {
  AmbientLight, BufferAttribute, BufferGeometry, CanvasTexture, Color, ConeGeometry, CylinderGeometry, DirectionalLight,
  DoubleSide, Group,
  Mesh, MeshLambertMaterial, PerspectiveCamera, Scene, Sprite, SpriteMaterial, Vector3, WebGLRenderer
} from 'three';
export { TrackballControls } from 'three/addons/controls/TrackballControls.js';
