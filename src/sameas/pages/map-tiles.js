// ---- chart tiles of the user, from the server: squares of Web Mercator, drawn between the land and the grid ----
// At a zoom of z the world has 2^z by 2^z tiles. A tile that is not there, or not yet, or deeper than the chart, is drawn
// from the part of a larger one that covers it. Charts lie on each other in the order in which they are given.
const MOST_IN_VIEW = 160,
  MOST_FETCHES = 6,
  RETRY_MS = 10000,
  KEPT_PICTURES = 300,
  KEPT_SPRITES = 200,
  // Sprites that are made in one frame: a frame must not take longer than the screen shows it.
  SPRITES_A_FRAME = 3;
// Of all charts together: a browser opens six connections to a server.
let fetches = 0;

const tileKey = (z, x, y) => `${z}/${x}/${y}`;
// The columns of the world begin anew at the 180th meridian.
const modulo = (v, n) => ((v % n) + n) % n;
// [x, y] of a place of the world in tiles of a zoom, and back to the plane.
const inTiles = (lat, lon, z) => {
  const sine = Math.sin(Math.min(Math.max(lat, -85.05), 85.05) * RAD);
  return [((lon + 180) / 360) * 2 ** z, (0.5 - Math.log((1 + sine) / (1 - sine)) / (4 * Math.PI)) * 2 ** z];
};
const ofTiles = (x, y, z) => earth.toPlane(Math.atan(Math.sinh(Math.PI * (1 - (2 * y) / 2 ** z))) / RAD, (x / 2 ** z) * 360 - 180);

// A chart of tiles: draws what is in the view, and says whether all of it is there. TILES : { number, layer, zooms, bounds }.
function chartOfTiles(TILES) {
  // By zoom/column/row: { picture, none, failed, asked, used }; and of each tile a canvas with it as it lies in the plane.
  const pictures = new Map(),
    chartSprites = new Map();
  let tileSize = 256,
    wantedTiles = [],
    scaleBefore = 0,
    frameNumber = 0,
    complete = false,
    awaited = false; // a tile that failed, to be asked for again

  // The range of tiles of a zoom in the view: west, north, east, south, inclusive; null if there are too many.
  function tilesInView(z, w, h) {
    const [middleLat, middleLon] = earth.toEarth(view.x, view.y) || [NaN, NaN];
    if (Number.isNaN(middleLat)) return null;
    let [west, north, east, south] = [Infinity, Infinity, -Infinity, -Infinity];
    for (let i = 0; i <= 4; i++)
      for (let j = 0; j <= 4; j++) {
        const g = earth.toEarth(...toMetres((w * i) / 4, (h * j) / 4));
        if (!g) return null;
        // On the same side of the 180th meridian as the middle.
        const [x, y] = inTiles(g[0], middleLon + modulo(g[1] - middleLon + 180, 360) - 180, z);
        [west, north, east, south] = [Math.min(west, x), Math.min(north, y), Math.max(east, x), Math.max(south, y)];
      }
    const last = 2 ** z - 1,
      [west_, south_, east_, north_] = TILES.bounds,
      [least, top] = inTiles(north_, west_, z),
      [most, low] = inTiles(south_, east_, z);
    const crosses = west < 0 || east > last + 1;
    const box = [
      Math.floor(crosses ? west : Math.max(west, least)),
      Math.max(Math.floor(Math.max(north, top)), 0),
      Math.floor(crosses ? east : Math.min(east, most)),
      Math.min(Math.floor(Math.min(south, low)), last),
    ];
    return (box[2] - box[0] + 1) * (box[3] - box[1] + 1) > MOST_IN_VIEW ? null : box;
  }
  // The zoom at which a pixel of a tile is about one of the screen.
  function zoomOfView(ratio) {
    const g = earth.toEarth(view.x, view.y);
    if (!g) return TILES.zooms[0];
    const world = 2 * Math.PI * A * Math.cos(g[0] * RAD);
    return Math.max(Math.round(Math.log2((world * view.scale * ratio) / tileSize)), TILES.zooms[0]);
  }

  function tilePicture(z, x, y) {
    const known = pictures.get(tileKey(z, modulo(x, 2 ** z), y));
    return known && known.picture ? known : null;
  }
  // The nearest picture that covers a tile: itself, or a larger one, with the part of it in shares of its side.
  function cover(z, x, y) {
    for (let up = Math.max(z - TILES.zooms[1], 0); z - up >= TILES.zooms[0]; up++) {
      const known = tilePicture(z - up, Math.floor(x / 2 ** up), Math.floor(y / 2 ** up));
      if (!known) continue;
      known.used = frameNumber;
      const side = 1 / 2 ** up;
      return { known, left: modulo(x, 2 ** up) * side, top: modulo(y, 2 ** up) * side, side };
    }
    return null;
  }
  // Draws a tile into a context whose pixels are those of the screen, from the point (u0, v0) of the plane in such pixels.
  function drawTile(c, z, x, y, part, pixels, u0, v0) {
    // The curvature of a tile is below half a pixel from zoom 10 on; larger ones are drawn in pieces.
    const pieces = Math.max(1, 2 ** Math.max(0, Math.min(10 - z, 4))),
      image = part.known.picture,
      from = part.side / pieces;
    const corner = (i, j) => {
      const p = ofTiles(x + i / pieces, y + j / pieces, z);
      return p && [p[0] * pixels - u0, -p[1] * pixels - v0];
    };
    for (let i = 0; i < pieces; i++)
      for (let j = 0; j < pieces; j++) {
        const [o, a, b] = [corner(i, j), corner(i + 1, j), corner(i, j + 1)];
        if (!o || !a || !b) continue;
        const wide = Math.hypot(a[0] - o[0], a[1] - o[1]),
          high = Math.hypot(b[0] - o[0], b[1] - o[1]);
        // A little more on each side: no gaps between tiles.
        const [gapX, gapY] = [0.8 / wide, 0.8 / high];
        c.setTransform(a[0] - o[0], a[1] - o[1], b[0] - o[0], b[1] - o[1], o[0], o[1]);
        const [sx, sy] = [(part.left + i * from) * image.width, (part.top + j * from) * image.height];
        c.drawImage(image, sx, sy, from * image.width, from * image.height, -gapX, -gapY, 1 + 2 * gapX, 1 + 2 * gapY);
      }
  }
  // The canvas of a tile at this scale, with its place in pixels of the plane; made if there is none.
  function tileSprite(z, x, y, part, pixels, mayMake) {
    const key = tileKey(z, x, y),
      known = chartSprites.get(key);
    if (known && known.pixels === pixels && known.picture === part.known.picture && known.night === night) {
      known.used = frameNumber;
      return known;
    }
    if (!mayMake()) return null;
    const corners = [
      [0, 0],
      [1, 0],
      [0, 1],
      [1, 1],
      [0.5, 0],
      [0.5, 1],
    ].map(([i, j]) => ofTiles(x + i, y + j, z));
    if (corners.some(p => !p)) return null;
    const us = corners.map(p => p[0] * pixels),
      vs = corners.map(p => -p[1] * pixels);
    const u0 = Math.floor(Math.min(...us)) - 1,
      v0 = Math.floor(Math.min(...vs)) - 1;
    const canvas = known ? known.canvas : document.createElement("canvas");
    canvas.width = Math.ceil(Math.max(...us)) + 1 - u0;
    canvas.height = Math.ceil(Math.max(...vs)) + 1 - v0;
    const c = canvas.getContext("2d");
    drawTile(c, z, x, y, part, pixels, u0, v0);
    if (night) darken(c, canvas.width, canvas.height);
    const made = { canvas, u0, v0, pixels, picture: part.known.picture, night, used: frameNumber };
    chartSprites.set(key, made);
    return made;
  }
  // At night a chart is dim, as the rest of the bridge.
  function darken(c, wide, high) {
    c.setTransform(1, 0, 0, 1, 0, 0);
    c.globalCompositeOperation = "source-atop";
    c.fillStyle = "#050c14b8";
    c.fillRect(0, 0, wide, high);
    c.globalCompositeOperation = "source-over";
  }

  function drawChart(c, w, h) {
    if (!shown[TILES.layer]) return;
    frameNumber++;
    const ratio = window.devicePixelRatio || 1,
      pixels = view.scale * ratio,
      z = zoomOfView(ratio),
      box = tilesInView(z, w, h);
    wantedTiles = [];
    awaited = complete = false;
    if (!box) return;
    // Place of the screen's corner in pixels of the plane. Rounded: all sprites are moved by whole pixels.
    const u = Math.round(view.x * pixels - (w / 2) * ratio),
      v = Math.round(-view.y * pixels - (h / 2) * ratio);
    const steady = pixels === scaleBefore,
      middle = [(box[0] + box[2]) / 2, (box[1] + box[3]) / 2];
    scaleBefore = pixels;
    let made = 0,
      unmade = false;
    const mayMake = () => {
      const may = steady && made++ < SPRITES_A_FRAME;
      unmade = unmade || !may;
      return may;
    };
    c.save();
    for (let x = box[0]; x <= box[2]; x++)
      for (let y = box[1]; y <= box[3]; y++) {
        want(z, x, y, Math.hypot(x - middle[0], y - middle[1]));
        const part = cover(z, x, y);
        if (!part) continue;
        const sprite = tileSprite(z, x, y, part, pixels, mayMake);
        if (sprite) {
          c.setTransform(1, 0, 0, 1, 0, 0);
          c.drawImage(sprite.canvas, sprite.u0 - u, sprite.v0 - v);
        } else {
          if (night) c.globalAlpha = 0.28;
          drawTile(c, z, x, y, part, pixels, u, v);
          c.globalAlpha = 1;
        }
      }
    c.restore();
    forget(pictures, KEPT_PICTURES);
    forget(chartSprites, KEPT_SPRITES);
    complete = !unmade && !wantedTiles.length && !fetches && !awaited;
    fetchTiles();
    if (unmade) draw();
  }
  function forget(kept, most) {
    if (kept.size <= most) return;
    const old = [...kept.entries()].filter(([, one]) => one.used < frameNumber).sort((a, b) => a[1].used - b[1].used);
    for (const [key, one] of old.slice(0, kept.size - most)) {
      kept.delete(key);
      if (one.picture && one.picture.close && kept === pictures) one.picture.close();
    }
  }

  // ---- what the server is asked for: nearest to the middle first, few at a time ----
  function want(z, x, y, far) {
    const up = Math.max(z - TILES.zooms[1], 0),
      zoom = z - up,
      column = modulo(Math.floor(x / 2 ** up), 2 ** zoom),
      row = Math.floor(y / 2 ** up),
      key = tileKey(zoom, column, row),
      known = pictures.get(key);
    if (known) {
      known.used = frameNumber;
      // Where the chart has no tile, the next larger one is there instead.
      if (known.none && zoom > TILES.zooms[0]) return want(zoom - 1, Math.floor(x / 2 ** (up + 1)), Math.floor(row / 2), far);
      if (known.picture || known.asked || known.none) return;
      if (performance.now() < known.failed) {
        awaited = true;
        return;
      }
    }
    wantedTiles.push({ key, far });
  }
  function fetchTiles() {
    wantedTiles.sort((a, b) => a.far - b.far);
    // Several tiles may want the same larger one.
    wantedTiles = [...new Map(wantedTiles.map(one => [one.key, one])).values()];
    for (const { key } of wantedTiles.splice(0, Math.max(MOST_FETCHES - fetches, 0))) {
      const known = pictures.get(key);
      if (known && known.asked) continue;
      fetchTile(key);
    }
  }
  async function fetchTile(key) {
    const tile = { picture: null, none: false, failed: 0, asked: true, used: frameNumber };
    pictures.set(key, tile);
    fetches++;
    try {
      const answer = await fetch(`chart/${TILES.number}/${key}`);
      if (answer.status === 200) {
        tile.picture = await createImageBitmap(await answer.blob());
        tileSize = tile.picture.width;
      } else if (answer.status === 204) tile.none = true;
      else tile.failed = performance.now() + RETRY_MS;
    } catch {
      tile.failed = performance.now() + RETRY_MS;
    }
    tile.asked = false;
    fetches--;
    draw();
  }
  return { draw: drawChart, isDrawn: () => !shown[TILES.layer] || complete };
}

// An overlay of lines: shores, fairways, limits of areas.
function chartOfLines(lines, layer) {
  const strokes = path([...lines.land.map(line => [...line, line[0], line[1]]), ...lines.coast], false);
  return c => {
    if (!shown[layer]) return;
    c.save();
    c.translate(view.w / 2, view.h / 2);
    c.scale(view.scale, -view.scale);
    c.translate(-view.x, -view.y);
    c.setLineDash([]);
    c.lineWidth = 1.5 / view.scale;
    c.strokeStyle = colour.accent;
    c.stroke(strokes);
    c.restore();
  };
}

// ---- the charts of the user, each with its tick ----
const charts = earth && data.live ? data.live.charts : [];
const tileCharts = [];
charts.forEach((chart, number) => {
  chart.layer = charts.length === 1 ? "chart" : `chart ${number + 1}`;
  shown[chart.layer] = true;
  if (chart.zooms) {
    const tiles = chartOfTiles({ ...chart, number });
    tileCharts.push(tiles);
    underlays.push(tiles.draw);
  } else if (chart.overlay === null) landLayer = chart.layer;
  else underlays.push(chartOfLines(data.overlays[chart.overlay], chart.layer));
});
window.mapPage.chartIsDrawn = () => tileCharts.every(one => one.isDrawn()) && !pending;
// The uppermost first, as on the map.
charts.forEach(chart => {
  const label = document.createElement("label"),
    tick = document.createElement("input");
  tick.type = "checkbox";
  tick.checked = true;
  tick.dataset.layer = chart.layer;
  tick.addEventListener("change", () => {
    shown[chart.layer] = tick.checked;
    draw();
  });
  label.append(tick, ` ${charts.length === 1 ? "chart" : chart.name}`);
  el("layers").prepend(label);
});
const chartCredits = [...new Set(charts.map(chart => chart.credit).filter(Boolean))];
if (chartCredits.length) {
  el("credit").textContent = [`chart: ${chartCredits.join(", ")}`, el("credit").textContent].filter(Boolean).join("; ");
  el("credit").classList.add("of-chart");
}
