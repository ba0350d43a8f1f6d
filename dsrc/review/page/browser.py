"""Address bar of a browser, and the script that a live page runs there before viser's own.

viser tells the server nothing about the address of the page, cannot write or copy it, leaves the focus in a dropdown
after a choice, maps all colours to paler ones and shows an empty page until something is drawn. The script does these
things, makes pictures with legend and card, goes to the addresses that the server writes, and to those of links on the
page without loading it again, and tells which frame of a plot is clicked; nothing of the page depends on more.
"""

import time
from collections.abc import Callable

import viser

LINK_KEY = "review-link"
"""Key of the browser's storage under which the server writes the query that the address bar shows."""

PICTURE_KEY = "review-picture"
"""The same of a picture to save: JSON of its file name, the data URL of the scene and the HTML drawn over it."""
OPEN_KEY = "review-open"
"""The same of an address to go to."""
COPY_KEY = "review-copy"
"""The same of the wish to copy the address."""

LINK_PAUSE_S = 0.3
"""Least time between two links of one browser, s: Safari takes a hundred changes of the address in 30 s."""

HONEST_COLORS = """
(()=>{const t=setInterval(()=>{const m=window.__viserMutable,s=m&&m.scene,r=s&&s.__r3f&&(s.__r3f.root||s.__r3f);
 const gl=r&&r.getState&&r.getState().gl;if(gl){gl.toneMapping=0;clearInterval(t);m.requestRender();}},20);
})();
"""
"""Switch tone mapping off: colours of lines and unlit faces are shown as they are sent."""

_DRAWING = """
(()=>{const text=document.createElement('p');text.id='review-drawing';text.textContent='drawing \u2026';
text.style='position:fixed;inset:0;margin:auto;width:fit-content;height:fit-content;padding:6px 16px;z-index:1;'
 +'border-radius:8px;pointer-events:none;font:15px system-ui,sans-serif;color:#fff;background:rgba(13,16,23,.8)';
document.documentElement.append(text);})();
"""
# The first link takes it away: the server writes it once the first frame is drawn, or told why it cannot be.

_LINK = """
(()=>{const post=Worker.prototype.postMessage;
Worker.prototype.postMessage=function(d,...rest){
 if(d&&(d.type==='set_server'||d.type==='retry')){
  if(d.server)this.reviewServer=d.server;
  if(connection!==this){connection=this;this.addEventListener('message',e=>{
   if(e.data.type==='connected')setTimeout(()=>window.__viserMutable?.sendCamera?.(),100);});}
  if(this.reviewServer)d={type:'set_server',server:this.reviewServer+'/'+location.search};}
 return post.call(this,d,...rest);};
let connection=null;
const again=()=>connection&&window.__viserMutable?.sendCamera?connection.postMessage({type:'retry'}):location.reload();
window.addEventListener('popstate',again);
const linkAt=node=>node?.closest?.('a[href^="?"]');
let pressed=null;
document.addEventListener('pointerdown',e=>{pressed=linkAt(e.target);},true);
document.addEventListener('pointerup',e=>{
 if(!e.button&&pressed&&!pressed.isConnected&&!(e.ctrlKey||e.metaKey||e.shiftKey))linkAt(e.target)?.click();},true);
document.addEventListener('click',e=>{const a=linkAt(e.target);
 if(!a||e.button||e.ctrlKey||e.metaKey||e.shiftKey)return;
 e.preventDefault();show(a.getAttribute('href').slice(1),'pushState');again();},true);
const goes=e=>{const s=e.buttons&1&&e.target.closest&&e.target.closest('svg[data-ends]');if(!s||!connection)return;
 const [a,b,m]=s.dataset.ends.split(',').map(Number),r=s.getBoundingClientRect();
 const at=Math.min(Math.max(((e.clientX-r.x)/r.width-m)/(1-2*m),0),1),updates={value:Math.round(a+at*(b-a))};
 connection.postMessage({type:'send',
  message:{type:'GuiUpdateMessage',uuid:s.closest('[data-goto]').dataset.goto,updates}});};
for(const kind of ['pointerdown','pointermove'])document.addEventListener(kind,goes,true);
const own=['fixedDpr','darkMode','showStats','websocket','pair'],store=Storage.prototype.setItem;
const show=(link,change)=>{const kept=new URLSearchParams(location.search);
 const text=[...own.filter(k=>kept.has(k)).map(k=>k+'='+kept.get(k)),...(link?[link]:[])].join('&');
 history[change](null,'',text?'?'+text:location.pathname);};
const page=new URLSearchParams(location.search).has('pair')?parent:window;
const copy=()=>{
 const {origin,pathname,search}=page.location;
 const text=origin+pathname+'?'+search.slice(1).split('&').filter(part=>!own.includes(part.split('=')[0])).join('&');
 const ask=()=>prompt('Link',text);
 if(navigator.clipboard)navigator.clipboard.writeText(text).catch(ask);else ask();};
window.reviewPicture=async(url,html)=>{
 const load=async src=>{const image=new Image();image.src=src;await image.decode();return image;};
 const scene=await load(url),{width,height}=scene;
 const {body}=new DOMParser().parseFromString('<body style="margin:0;position:relative;height:100%">'+html,'text/html');
 // Nobody folds or scrolls in a picture: what is too tall for it is drawn smaller.
 const panels=body.querySelector('#review-panels'),host=document.createElement('div');
 panels.className='still';
 host.style.cssText=`position:absolute;visibility:hidden;left:0;top:0;width:${width}px;height:${height}px`;
 host.innerHTML=body.innerHTML;document.body.append(host);
 panels.style.zoom=Math.min((height-28)/host.querySelector('#review-panels').offsetHeight,1);
 host.remove();
 const svg=`<svg xmlns="http://www.w3.org/2000/svg" width="${width}" height="${height}">`
  +'<foreignObject width="100%" height="100%">'+new XMLSerializer().serializeToString(body)+'</foreignObject></svg>';
 const canvas=Object.assign(document.createElement('canvas'),{width,height}),drawn=canvas.getContext('2d');
 for(const one of [scene,await load('data:image/svg+xml,'+encodeURIComponent(svg))])drawn.drawImage(one,0,0);
 return canvas.toDataURL();};
Storage.prototype.setItem=function(key,value){
 if(key.endsWith('__OPEN_KEY__')){page.location.href=new URL('.'+value,location.href).href;return;}
 if(key.endsWith('__COPY_KEY__')){copy();return;}
 if(key.endsWith('__PICTURE_KEY__')){const [download,url,html]=JSON.parse(value);
  window.reviewPicture(url,html).then(href=>Object.assign(document.createElement('a'),{href,download}).click());return;}
 if(!key.endsWith('__LINK_KEY__'))return store.call(this,key,value);
 document.getElementById('review-drawing')?.remove();
 show(value,'replaceState');
 if(window.parent!==window)window.parent.postMessage({review:value||''},location.origin);};
})();
"""
for _name, _key in (("LINK", LINK_KEY), ("OPEN", OPEN_KEY), ("COPY", COPY_KEY), ("PICTURE", PICTURE_KEY)):
    _LINK = _LINK.replace(f"__{_name}_KEY__", _key)
# A table that is written anew between press and release takes the pressed link away, and the browser then clicks
# nothing: the link that lies there now is meant.
# viser sends its camera when it is connected after a loss; with a connection that follows another it has to be asked.
# viser's own command writes to the storage, wherever the panels are; the script takes the link out of its way.

_KEYS = """
(()=>{const free=()=>setTimeout(()=>{const a=document.activeElement;
 if(a&&a.getAttribute('aria-haspopup')==='listbox')a.blur();},0);
document.addEventListener('click',e=>{if(e.target.closest&&e.target.closest('[role=option]'))free();},true);
document.addEventListener('keyup',e=>{if(e.key==='Enter'||e.key==='Escape')free();},true);
document.addEventListener('keydown',e=>{
 if(e.key!=='?'||/INPUT|TEXTAREA/.test(document.activeElement.tagName))return;
 document.documentElement.dispatchEvent(new KeyboardEvent('keydown',{key:'H',code:'KeyH',bubbles:true}));},true);
})();
"""

NOTICE = """
(()=>{const seen=new WeakSet(),t=setInterval(()=>{
 for(const one of document.querySelectorAll('.mantine-Notification-root')){
  if(seen.has(one)||!one.innerText.includes('Software WebGL'))continue;
  seen.add(one);clearInterval(t);
  // Of cells side by side the first one says it.
  const first=window.parent===window||window.frameElement?.id==='cell0';
  if(!first)one.style.display='none';
  setTimeout(()=>one.querySelector('button')?.click(),first?6000:0);}},100);
})();
"""
"""Take the message that a browser draws in software away after 6 s: it is worth telling once, and not for good."""

_FOLD = """
(()=>{if(innerWidth>=576)return;const t=setInterval(()=>{
 const head=[...document.querySelectorAll('div')].find(e=>e.style.cursor==='pointer'&&e.style.height==='3.5em');
 if(head){clearInterval(t);head.click();}},50);})();
"""
# viser puts all panels of a window below 576 px into a sheet, which covers most of a cell.

_TYPE = """<style>html{font-size:16px!important}
.mantine-Slider-markLabel,.uplot,.uplot *,.mantine-Badge-label{font-size:12px!important}</style>"""
# viser's smallest text is 8 px; its labels are three quarters of the page's size.

HEAD = f"{_TYPE}<script>{_DRAWING}{HONEST_COLORS}{_LINK}{_KEYS}{NOTICE}{_FOLD}</script>"
"""What a live page's head begins with."""


class AddressBar:
    """Address bar of a browser, which shows the link of what is drawn.

    Attributes:
        link: query that it shows.
    """

    def __init__(self, client: viser.ClientHandle) -> None:
        self.link = ""
        self._client, self._behind, self._written_at = client, False, 0.0

    def fall_behind(self) -> None:
        """Mark that something has changed."""
        self._behind = True

    @property
    def due(self) -> float | None:
        """Time from which it may be written, of the monotonic clock, s; None where nothing has changed."""
        return self._written_at + LINK_PAUSE_S if self._behind else None

    def write(self, link: Callable[[], str]) -> None:
        """Write the link where it is due; the first one in any case, for it ends the text of a page without a frame."""
        if self.due is None or time.monotonic() < self.due:
            return
        first = self._written_at == 0.0
        self._behind, self._written_at = False, time.monotonic()
        if (text := link()) != self.link or first:
            self.link = text
            self._client.local_storage.set_item(LINK_KEY, text)
